"""What ``trade up`` tells of its devices: a line when something is wrong with one, and when it is well again."""

from collections.abc import Mapping
from datetime import datetime
from typing import Final

from rich.markup import escape

from trade_drivers import FaultInfo, FaultLog, Gripper, Motor
from trade_gateway.cli._output import Output, as_commands

__all__ = ["FaultWatch"]

_CALLS: Final = ((Motor, "enable"), (Gripper, "activate"))
"""What helps once the cause is gone."""


class FaultWatch:
    """Compares what a robot's log of faults says is wrong now with what it said before.

    Args:
        log: of the robot.
        providers: its devices by name.
    """

    def __init__(self, log: FaultLog, providers: Mapping[str, object]) -> None:
        self._log = log
        self._providers = providers
        self._known: dict[str, FaultInfo] = {}
        """By device, what was told of it."""

    def begin(self, out: Output) -> None:
        """Say what is wrong, or that nothing is."""
        if not self.tell(out):
            out.say(f"{_now():%H:%M:%S} no joint has a fault")

    def tell(self, out: Output) -> bool:
        """Say what has changed since the last time; returns whether anything has. Of several faults the newest."""
        found = reversed(self._log.faults(open_only=True))
        now = {info.device: info for info in found}
        before, self._known = self._known, now
        changed = [device for device in {**before, **now} if _kind(before.get(device)) != _kind(now.get(device))]
        for device in changed:
            self._say(out, device, now.get(device))
        return bool(changed)

    def _say(self, out: Output, device: str, info: FaultInfo | None) -> None:
        text = "" if info is None else self._sentence(info)
        if out.as_json:
            out.data({"at": _now().isoformat(timespec="milliseconds"), "joint": device, "fault": text})
        elif info is None:
            out.say(f"{_now():%H:%M:%S} [green]{device}: well again[/]")
        else:
            out.say(f"{_now():%H:%M:%S} [bold red]{escape(text)}[/]")

    def _sentence(self, info: FaultInfo) -> str:
        device = self._providers.get(info.device)
        call = next((name for kind, name in _CALLS if isinstance(device, kind)), "")
        if not info.remedy or not call:
            return f"{info.text}; {as_commands(info.device, info.remedy)}" if info.remedy else info.text
        end = "" if info.text.endswith("?") else "."
        return f"{info.text}{end} When you have looked: trade call {info.device}.{call}"


def _kind(info: FaultInfo | None) -> str:
    return "" if info is None else info.kind


def _now() -> datetime:
    return datetime.now().astimezone()
