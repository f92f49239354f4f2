"""Setting up servos of any vendor, with the registers as parameters."""

from abc import abstractmethod
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar, Final, Generic, TypeVar

from trade_drivers.bus._jobs import BadAnswer, NoAnswer, RequestRefused
from trade_drivers.commissioning._commissioner import Bench, ScannedDevice
from trade_drivers.joints import Resolution
from trade_drivers.joints.serial._axis import Register

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire

_LOOKS: Final = 3
_SHARED: Final = (
    "the answer is garbled or arrives twice: two devices may share this id, or there is noise. Unplug all devices "
    "but one, give it its own id, then plug in the next"
)

_UNKNOWN: Final = "this driver does not know that model; check it with the vendor's tool"
_Wire = TypeVar("_Wire", bound="ServoWire")


class ServoBench(Bench, Generic[_Wire]):
    """An open line of servos."""

    driver: ClassVar[str]
    restless: ClassVar[tuple[int, int]]
    """Address and size of values that differ between servos, since two with equal answers would look like one."""
    mute: ClassVar[str]
    """The problem of a servo that answers a ping but no read."""
    resolution: ClassVar[Resolution]
    torque: ClassVar[Register]
    position: ClassVar[Register]
    homing: ClassVar[Register]

    def __init__(self, wire: _Wire, baud: int) -> None:
        self.wire = wire
        self._baud = baud

    @abstractmethod
    def model_of(self, number: int) -> str:
        """Returns the name of a model; empty if this driver does not know it."""

    @abstractmethod
    def firmware_of(self, device_id: int) -> str:
        """Returns the firmware version."""

    def anybody(self) -> bool:
        return True

    def look(self, device_id: int) -> ScannedDevice | None:
        found = self._look(device_id)
        if found is not None and found.problem == _SHARED:
            late = all(self._look(device_id) is None for _ in range(_LOOKS - 1))  # it was an answer of another id
            return None if late else found
        for _ in range(_LOOKS - 1):
            if found is not None and found.problem == self.mute:  # one lost answer does not prove that
                found = self._look(device_id)
        return found

    def _look(self, device_id: int) -> ScannedDevice | None:
        try:
            number = self.wire.ping(device_id)
        except BadAnswer:
            return self._found(device_id, problem=_SHARED)
        except NoAnswer:
            self.wire.settled_at = 0.0  # a late answer must not be taken for that of the next id
            return None
        model = self.model_of(number)
        if not model:  # the meaning of its registers is unknown
            return self._found(device_id, f"model number {number}", problem=_UNKNOWN)
        try:
            shared = self.wire.answers_twice()
            for _ in range(_LOOKS):
                self.wire.read(device_id, *self.restless)
                shared = shared or self.wire.answers_twice()
            firmware, torque = self.firmware_of(device_id), self.read(device_id, self.torque) != 0
            homing = self.read(device_id, self.homing)
        except BadAnswer:
            return self._found(device_id, problem=_SHARED)
        except NoAnswer:
            self.wire.settled_at = 0.0
            return self._found(device_id, model, problem=self.mute)
        except RequestRefused as refused:
            return self._found(device_id, model, problem=f"it refuses to be read: {refused}")
        return self._found(device_id, model, firmware, torque, _SHARED if shared else "", homing)

    def _found(
        self,
        device_id: int,
        model: str = "",
        firmware: str = "",
        torque: bool | None = None,
        problem: str = "",
        homing_counts: int = 0,
    ) -> ScannedDevice:
        return ScannedDevice(
            driver=self.driver,
            baud=self._baud,
            id=device_id,
            model=model,
            firmware=firmware,
            homing_counts=homing_counts,
            torque=torque,
            problem=problem,
        )

    def angle_rad(self, device_id: int) -> float:
        return (self.read(device_id, self.position) - self.resolution.centre) * self.resolution.rad

    def homing_counts(self, device_id: int) -> int:
        return self.read(device_id, self.homing)

    def read(self, device_id: int, register: Register) -> int:
        """Returns the value of a register, in counts."""
        return register.decode(self.wire.read(device_id, register.address, register.size).data, register.address)

    def write(self, device_id: int, register: Register, value: int) -> None:
        """Writes once without a retry, since the answer may come under another id or at another rate."""
        with suppress(NoAnswer):
            self.wire.write(device_id, register.address, register.encode(value))

    def close(self) -> None:
        self.wire.close()
