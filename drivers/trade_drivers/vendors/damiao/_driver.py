"""The driver of a bus of Damiao motors, and its scan, which reads registers; it enables and writes nothing."""

from collections.abc import Callable
from math import isclose
from typing import TYPE_CHECKING, Final, TypeVar

from trade_drivers.commissioning._can_scan import CanBench
from trade_drivers.commissioning._commissioner import ScannedDevice
from trade_drivers.joints.can import CanMotorCommissioner, CanMotorDriver
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao import _table as table
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._frames import Feedback
from trade_drivers.vendors.damiao._table import MASTER, MODELS, Ranges, Register, Status

if TYPE_CHECKING:
    from trade_drivers.bus.can import Frame
    from trade_drivers.vendors.damiao._exchange import DamiaoExchange

_ANSWER_S: Final = 0.05
_WHOLE_SECOND_ANSWER_S: Final = 0.005
_SHARED: Final = (
    "two motors answer to this number. Unplug all but one, give it a number of its own with the vendor's tool, then "
    "plug in the next"
)

_Value = TypeVar("_Value")


class _Silent(Exception):
    """No answer came."""


class DamiaoBench(CanBench):
    """One CAN bus with Damiao motors."""

    driver = "damiao"
    remedy = "the vendor's tool"
    zero = "its zero is set by the vendor's tool"

    orders = staticmethod(table.orders)

    def anybody(self) -> bool:
        return True

    def look(self, device_id: int) -> ScannedDevice | None:
        try:
            answers = self._register(device_id, Register.POSITION_MAX)
        except _Silent:
            return None
        if len(answers) > 1:
            return self.found(device_id, problem=_SHARED)
        [(can_id, position)] = answers
        if can_id != device_id + MASTER:
            wanted = device_id + MASTER
            problem = f"it answers as {can_id:X}h; set its MST_ID (register 7) to {wanted:X}h by {self.remedy}"
            return self.found(device_id, problem=problem)
        try:
            rest = [self._register(device_id, one)[0][1] for one in (Register.VELOCITY_MAX, Register.TORQUE_MAX)]
            software = self._register(device_id, Register.SOFTWARE)[0][1]
            status = self._status(device_id)
        except _Silent:
            return self.found(device_id, problem="it answers only sometimes; check its cable and the terminations")
        reported = Ranges(position, *rest)
        names = [name for name, ranges in MODELS.items() if all(map(_alike, ranges, reported))]
        return self.found(
            device_id,
            " or ".join(names),
            firmware=f"{software:g}",
            torque=status == Status.ENABLED,
            problem="" if names else f"no known model has its limits (registers 21 to 23): {reported}",
        )

    def _register(self, motor: int, number: Register) -> list[tuple[int, float]]:
        """Returns the identifiers and values of all answers. Raises ``_Silent``."""

        def decode(frame: "Frame") -> tuple[int, float] | None:
            value = frames.answer(frame.data, motor, number) if frame.id != table.BROADCAST else None
            return None if value is None else (frame.id, value)

        return self._ask(frames.read(motor, number), decode)

    def _status(self, motor: int) -> int:
        def decode(frame: "Frame") -> int | None:
            if frame.id != motor + MASTER or len(frame.data) != len(frames.ENABLE):
                return None
            return Feedback.decode(frame.data, Ranges(0, 0, 0)).status

        return self._ask(frames.refresh(motor), decode)[0]

    def _ask(self, question: bytes, decode: "Callable[[Frame], _Value | None]") -> list[_Value]:
        """Returns the answers, including a second one if there are two motors. Raises ``_Silent``."""
        answers = self.ask(table.BROADCAST, question, decode, _ANSWER_S, _WHOLE_SECOND_ANSWER_S)
        if not answers:
            raise _Silent
        return answers


def _alike(meant: float, reported: float) -> bool:
    return isclose(meant, reported, rel_tol=1e-3)


class DamiaoCommissioner(CanMotorCommissioner):
    """Damiao motors; factory default: id 1, and no answer id of their own."""

    driver = "damiao"
    ids = range(1, MASTER)

    def bench(self) -> type[DamiaoBench]:
        return DamiaoBench


class DamiaoDriver(CanMotorDriver[DamiaoAxis, "DamiaoExchange"]):
    """Damiao motors on a CAN bus.

    In a robot file::

        [bus.arm]
        driver = "damiao"
        interface = "socketcan"
        channel = "can0"

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "DM4310"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.0
        max_accel_rad_s2 = 10.0
    """

    name = "damiao"
    models = MODELS
    commissioner = DamiaoCommissioner
    orders = staticmethod(table.orders)

    def exchange_type(self) -> "type[DamiaoExchange]":
        from trade_drivers.vendors.damiao._exchange import DamiaoExchange  # noqa: PLC0415 - python-can is optional

        return DamiaoExchange
