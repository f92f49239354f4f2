"""``trade foxglove``: show live what ``trade record`` would write, over the Foxglove WebSocket protocol."""

import time
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from trade_gateway.cli._options import Groups, Json, Readers
from trade_gateway.cli._output import Output, complain
from trade_gateway.cli._system_choice import visitor
from trade_gateway.process._addresses import is_loopback
from trade_gateway.process._signals import leaving
from trade_gateway.recording import require
from trade_gateway.recording._recorder import Recorder
from trade_gateway.recording._sources import Wanted

if TYPE_CHECKING:
    from trade_gateway.recording._live import Live


def foxglove(
    context: typer.Context,
    group: Groups = None,
    services: Readers = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where viewers connect to; 0 takes a free one.")] = 8765,
    host: Annotated[
        str, typer.Option(help="Another address of this host lets everybody look on who reaches it: there is no login.")
    ] = "127.0.0.1",
    as_json: Json = False,
) -> None:
    """Show joints, cameras, calls, locks and faults live in Foxglove, until Ctrl-C.

    Viewers can only look on: nothing comes in from them. One that is slow misses messages, and slows nobody down.

    For example: trade foxglove --group rosie, and then open ws://localhost:8765 in Foxglove
    """
    require("foxglove", "foxglove")
    from trade_gateway.recording._live import Live  # noqa: PLC0415 - loads what the other commands do not need

    out, wanted = Output(as_json=as_json), Wanted(group or [], services or [])
    with (
        leaving() as ending,
        visitor(context) as container,
        Live(host, port, f"TRADE system {container.settings.system}") as live,
        Recorder(container, wanted, ending) as recorder,
    ):
        if not is_loopback(host):
            complain(
                f"whoever reaches {live.url} sees all of this: the protocol has no login, and nothing is encrypted"
            )
        _show(out, live, recorder)


def _show(out: Output, live: "Live", recorder: Recorder) -> None:
    telling = _Telling(out, live, recorder)
    telling.begin()
    recorder.run(live, None, telling.beat)
    telling.end()


class _Telling:
    """What is said meanwhile."""

    def __init__(self, out: Output, live: "Live", recorder: Recorder) -> None:
        self._out = out
        self._live = live
        self._recorder = recorder
        self._began = time.monotonic()
        self._refused = ""

    def begin(self) -> None:
        """Where to look, and what there is to be seen."""
        services = self._recorder.look()
        if self._out.as_json:
            self._out.data({"url": self._live.url, "services": services})
            return
        named = ", ".join(services) or "nothing yet that has joints or pictures"
        self._out.say(f"[bold green]live[/] at {self._live.url}: {escape(named)}; Ctrl-C ends")
        self._out.say("there is no login: every program and every web page open on this computer can look on")

    def beat(self) -> None:
        """What is to be complained of, and a line a second for programs."""
        self._live.greet()
        for notice in self._live.notices():
            complain(notice)
        if self._recorder.refused not in ("", self._refused):
            self._refused = self._recorder.refused
            complain(f"not all is shown: {self._refused}")
        if self._out.as_json:
            self._out.data(self._sums())

    def end(self) -> None:
        """What there was."""
        sums = self._sums()
        if not self._out.as_json:
            lost = f", {sums['dropped']} samples lost on the way here" if sums["dropped"] else ""
            self._out.say(f"[bold]shown[/]: {sums['messages']} messages in {sums['seconds']:.0f} s{lost}")

    def _sums(self) -> dict[str, float]:
        return {
            "messages": self._recorder.messages,
            "seconds": round(time.monotonic() - self._began, 3),
            "dropped": self._recorder.dropped,
            "behind": self._live.behind,
        }
