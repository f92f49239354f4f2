"""``trade gateway GATEWAY.toml``: join networks, and let across what the file and its policy allow."""

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Final

import typer

from trade import Container, Settings
from trade.errors import TradeError
from trade_gateway._gateway_file import digest, read_gateway_file
from trade_gateway._list import Json
from trade_gateway._output import Output, complain
from trade_gateway._up import leaving

_LOOK_EVERY_S: Final = 1.0
_TRIES: Final = 5


def gateway(
    file: Annotated[Path, typer.Argument(metavar="GATEWAY.toml", help="The gateway file.")],
    check: Annotated[bool, typer.Option("--check", help="Only say whether the file is right.")] = False,
    as_json: Json = False,
) -> None:
    """Carry calls between networks that have no way to each other, as far as the file and its policy allow.

    The file is read again when it changes, when its policy, its revoked names or its certificate do, and on SIGHUP.
    What is wrong with it is said, and the gateway goes on as before.

    For example: trade gateway /etc/trade/gateway.toml --check
    """
    out = Output(as_json=as_json)
    _, settings = read_gateway_file(file)
    if check:
        out.say(f"{file} is right")
        return
    with leaving() as asked_to_leave, _hangups() as hangup:
        running = Gateway(settings)
        try:
            seen = digest(file)
            _say_ready(out, running, settings)
            while not asked_to_leave.wait(_LOOK_EVERY_S):
                now = digest(file)
                if now != seen or hangup.is_set():
                    hangup.clear()
                    seen = now
                    running.reload(file, out)
        finally:
            running.close()
        out.say("leaving")


class Gateway:
    """The container that joins the networks; another one takes its place when the file changes."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._container = Container(settings)

    @property
    def container(self) -> Container:
        """The one that runs now."""
        return self._container

    def reload(self, file: Path, out: Output) -> bool:
        """Go by the file as it is now; returns whether that could be done. If not, all stays as it was."""
        try:
            _, settings = read_gateway_file(file)
        except TradeError as wrong:
            complain(f"{file} was changed and is wrong; going on as before: {wrong}")
            return False
        before, self._settings = self._settings, settings
        self._container.close()
        try:
            self._container = _opened(settings)
        except TradeError as refused:
            self._settings = before
            self._container = _opened(before)
            complain(f"{file} was changed and cannot be used; going on as before: {refused}")
            return False
        out.say(f"read {file} again")
        if out.as_json:
            out.data({"reloaded": str(file)})
        return True

    def close(self) -> None:
        """Leave all networks. Idempotent."""
        self._container.close()


def _opened(settings: Settings) -> Container:
    """The one before may need a moment to let go of its addresses."""
    for _ in range(_TRIES - 1):
        try:
            return Container(settings)
        except TradeError:
            threading.Event().wait(0.2)
    return Container(settings)


@contextmanager
def _hangups() -> Generator[threading.Event]:
    """An event that SIGHUP sets."""
    event = threading.Event()

    def heard(_number: int, _frame: FrameType | None) -> None:
        event.set()

    number = getattr(signal, "SIGHUP", None)
    before = None if number is None else signal.signal(number, heard)
    try:
        yield event
    finally:
        if number is not None:
            signal.signal(number, before)


def _say_ready(out: Output, running: Gateway, settings: Settings) -> None:
    if out.as_json:
        networks = {name: None if settings.exports is None else settings.exports[name] for name in settings.bridge}
        out.data(
            {
                "ready": True,
                "container": running.container.name,
                "system": settings.system,
                "identity": settings.identity,
                "listen": settings.listen,
                "networks": networks,
            }
        )
        return
    out.say(f"[bold green]{running.container.name} is up[/] in system {settings.system}, as {settings.identity}")
    for name in settings.bridge:
        groups = "everything" if settings.exports is None else ", ".join(settings.exports[name]) or "nothing"
        out.say(f"  {name}: others see {groups.replace('*', 'everything')} of it")
    out.say("Ctrl-C leaves; the file is read again when it changes")
