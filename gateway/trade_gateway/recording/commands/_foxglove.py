"""``trade foxglove``: shows live what ``trade record`` would write, over the Foxglove WebSocket protocol."""

import time
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.markup import escape

from trade_gateway.process._addresses import is_loopback
from trade_gateway.process._signals import leaving
from trade_gateway.recording import require
from trade_gateway.recording._recorder import Recorder
from trade_gateway.recording._sources import RecordedParts
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Groups, Json, Readers
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import visitor

if TYPE_CHECKING:
    from trade_gateway.recording._live import Live

SECTION: Final = sections.RECORDINGS
PLACE: Final = 1


def foxglove(
    context: typer.Context,
    group: Groups = None,
    services: Readers = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port that viewers connect to; 0 takes a free one.")
    ] = 8765,
    host: Annotated[
        str, typer.Option(help="Address to listen on. There is no login: any host that reaches it can view.")
    ] = "127.0.0.1",
    as_json: Json = False,
) -> None:
    """Show joints, cameras, calls, locks and faults live in Foxglove until Ctrl-C.

    Viewers are read-only. A slow viewer misses messages and delays nothing.

    For example: trade foxglove --group rosie, and then open ws://localhost:8765 in Foxglove
    """
    require("foxglove", "foxglove")
    from trade_gateway.recording._live import Live  # noqa: PLC0415 - loads what the other commands do not need

    out, wanted = Output(as_json=as_json), RecordedParts(group or [], services or [])
    with (
        leaving() as ending,
        visitor(context) as container,
        Live(host, port, f"TRADE system {container.settings.system}") as live,
        Recorder(container, wanted, ending) as recorder,
    ):
        if not is_loopback(host):
            complain(f"every host that reaches {live.url} sees all data: the protocol has no login and no encryption")
        _show(out, live, recorder)


def _show(out: Output, live: "Live", recorder: Recorder) -> None:
    progress = _Progress(out, live, recorder)
    progress.begin()
    recorder.run(live, None, progress.beat)
    progress.end()


class _Progress:
    """Output while the data is shown."""

    def __init__(self, out: Output, live: "Live", recorder: Recorder) -> None:
        self._stream = out
        self._live = live
        self._recorder = recorder
        self._began = time.monotonic()
        self._refused = ""

    def begin(self) -> None:
        """Prints the address and the services that are shown."""
        services = self._recorder.look()
        if self._stream.as_json:
            self._stream.data({"url": self._live.url, "services": services})
            return
        named = ", ".join(services) or "no service with joints or pictures yet"
        self._stream.say(f"[bold green]live[/] at {self._live.url}: {escape(named)}; Ctrl-C ends")
        self._stream.say("there is no login: every program and every open web page on this computer can view it")

    def beat(self) -> None:
        """Prints warnings, and one line per second for programs."""
        self._live.greet()
        for notice in self._live.notices():
            complain(notice)
        if self._recorder.refused not in ("", self._refused):
            self._refused = self._recorder.refused
            complain(f"some data is not shown: {self._refused}")
        if self._stream.as_json:
            self._stream.data(self._sums())

    def end(self) -> None:
        """Prints the totals."""
        sums = self._sums()
        if not self._stream.as_json:
            lost = f", {sums['dropped']} samples lost before they arrived here" if sums["dropped"] else ""
            self._stream.say(f"[bold]shown[/]: {sums['messages']} messages in {sums['seconds']:.0f} s{lost}")

    def _sums(self) -> dict[str, float]:
        return {
            "messages": self._recorder.messages,
            "seconds": round(time.monotonic() - self._began, 3),
            "dropped": self._recorder.dropped,
            "behind": self._live.behind,
        }
