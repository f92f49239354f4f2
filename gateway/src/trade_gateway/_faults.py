"""What ``trade up`` tells of its devices: a line when something is wrong with one, and when it is well again."""

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any

from msgspec import Struct
from rich.markup import escape

from trade.errors import DeviceError
from trade_drivers import Arm, ArmState, Gripper, Motor, Sensor
from trade_gateway._output import Output

__all__ = ["FaultWatch"]


class FaultWatch:
    """Compares what devices say of themselves with what they said before. Looking asks no device anything."""

    def __init__(self, providers: Mapping[str, Any]) -> None:
        self._devices = {
            name: device for name, device in providers.items() if isinstance(device, Motor | Gripper | Arm | Sensor)
        }
        self._known: dict[str, _Trouble] = dict.fromkeys(self._devices, _WELL)

    def begin(self, out: Output) -> None:
        """Say what is wrong, or that nothing is."""
        if not self.tell(out):
            out.say(f"{_now():%H:%M:%S} no joint has a fault")

    def tell(self, out: Output) -> bool:
        """Say what has changed since the last time; returns whether anything has."""
        changes = list(self._changes())
        for joint, trouble in changes:
            if out.as_json:
                out.data({"at": _now().isoformat(timespec="milliseconds"), "joint": joint, "fault": trouble.text})
            elif trouble == _WELL:
                out.say(f"{_now():%H:%M:%S} [green]{joint}: well again[/]")
            else:
                out.say(f"{_now():%H:%M:%S} [bold red]{escape(trouble.text)}[/]")
        return bool(changes)

    def _changes(self) -> Iterator[tuple[str, "_Trouble"]]:
        for joint, device in self._devices.items():
            trouble = _trouble(joint, device)
            if trouble.kind != self._known[joint].kind:
                self._known[joint] = trouble
                yield joint, trouble


class _Trouble(Struct, frozen=True):
    """What is wrong with a joint; nothing if the kind is empty."""

    kind: str
    text: str = ""
    """The joint, what is wrong with it, and what to do."""


_WELL = _Trouble("")


def _now() -> datetime:
    return datetime.now().astimezone()


def _trouble(joint: str, device: Motor | Gripper | Arm | Sensor) -> _Trouble:
    try:
        if isinstance(device, Sensor):
            device.read()
            return _WELL
        state = device.state()
    except DeviceError as silent:
        return _Trouble(type(silent).__name__, str(silent))
    except Exception as defect:  # noqa: BLE001 - a mistake of the driver's is told, and ends nothing
        return _Trouble(type(defect).__name__, f"{joint}: its state cannot be read: {defect!r}")
    if not (fault := state.fault):
        return _WELL
    if isinstance(state, ArmState):
        return _Trouble(fault, f"{joint}: {fault}; {state.remedy}")
    sentence = fault if fault.endswith("?") else f"{fault}."
    remedy = "enable" if isinstance(device, Motor) else "clear_fault"
    return _Trouble(fault, f"{joint}: {sentence} When you have looked: trade call {joint}.{remedy}")
