"""The faults and orders as plain values, so that they can be created in Python or sent over the control socket.

On a CAN bus every frame of a device is an answer, and its name (``heartbeat``, ``tpdo1``, ``sdo_reply``, ...) the
instruction; a fault that names a frame of clients (``sync``, ``rpdo1``, ...) affects that frame.

Two kinds: faults of answers, which change the bytes of some answers on their way out, and orders, which act once on
a device or on the line.
"""

from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta

Seconds = Annotated[float, Meta(ge=0, le=60)]
Byte = Annotated[int, Meta(ge=0, le=255)]


class SimulationError(ValueError):
    """A simulator cannot do what was requested; the message says what would be valid."""


class AnswerPart(NamedTuple):
    """Part of an answer, and the delay with which it leaves."""

    data: bytes
    late_s: float = 0.0


class _Order(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", forbid_unknown_fields=True):
    bus: str | None = None
    """Name of the bus; default: every bus."""


class _Devices(_Order, frozen=True, kw_only=True):
    ids: tuple[int, ...] | None = None
    """Affected devices; default: all on the bus."""


class AnswerFault(_Devices, frozen=True, kw_only=True):
    """A fault of answers, and which answers it affects."""

    instruction: str | None = None
    """Only answers to this instruction: ``ping``, ``read``, ``sync_read``, ...; default: any."""
    skip: Annotated[int, Meta(ge=0)] = 0
    """How many matching answers go out intact first."""
    count: Annotated[int, Meta(ge=1)] | None = None
    """How many answers it affects; default: all, until healed."""

    def strikes(self, ids: tuple[int, ...], instruction: str) -> bool:
        """Whether it affects an answer of these devices to this instruction."""
        whom = self.ids is None or any(i in self.ids for i in ids)
        return whom and self.instruction in {None, instruction}

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """The answer as this fault leaves it."""
        return pieces


class Mute(AnswerFault, frozen=True, tag="mute"):
    """Devices obey but do not answer."""

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """No part of the answer."""
        return pieces[:0]


class Late(AnswerFault, frozen=True, kw_only=True, tag="late"):
    """Answers arrive `s` seconds late; the bus continues meanwhile."""

    s: Seconds

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """The same, later."""
        return [AnswerPart(data, late_s + self.s) for data, late_s in pieces]


class BadCrc(AnswerFault, frozen=True, tag="bad_crc"):
    """The last byte of the answer is wrong. On a CAN bus: the frame is destroyed, and sent again."""

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """The same with its last byte inverted."""
        *before, (data, late_s) = pieces
        wrong = bytes(byte ^ 0xFF for byte in data[-1:])
        return [*before, AnswerPart(data[:-1] + wrong, late_s)]


class Truncate(AnswerFault, frozen=True, kw_only=True, tag="truncate"):
    """The answer breaks off; the last `missing` bytes never come."""

    missing: Annotated[int, Meta(ge=1)] = 3

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """The answer without its end."""
        *before, (data, late_s) = pieces
        return [*before, AnswerPart(data[: -self.missing], late_s)]


class Garbage(AnswerFault, frozen=True, kw_only=True, tag="garbage"):
    """Noise comes before the answer."""

    hex: str = "fffffd00ff"

    def __post_init__(self) -> None:
        """Refuse bytes that are not hex."""
        bytes.fromhex(self.hex)

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """Noise, then the same."""
        return [AnswerPart(bytes.fromhex(self.hex), pieces[0].late_s), *pieces]


class Dribble(AnswerFault, frozen=True, kw_only=True, tag="dribble"):
    """The answer comes byte by byte, `s` seconds apart."""

    s: Seconds

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """Single bytes, each with a greater delay."""
        whole, late_s = b"".join(piece.data for piece in pieces), pieces[0].late_s
        return [AnswerPart(bytes([byte]), late_s + k * self.s) for k, byte in enumerate(whole)]


class Duplicate(AnswerFault, frozen=True, tag="duplicate"):
    """The answer comes twice."""

    def shape(self, pieces: list[AnswerPart]) -> list[AnswerPart]:
        """The same answer twice in a row."""
        span_s = pieces[-1].late_s - pieces[0].late_s
        return [*pieces, *(AnswerPart(data, late_s + span_s) for data, late_s in pieces)]


class Echo(_Order, frozen=True, kw_only=True, tag="echo"):
    """The adapter sends back what it receives, as a half-duplex adapter without echo suppression does."""

    on: bool = True


class Unmute(_Devices, frozen=True, tag="unmute"):
    """End every `Mute` of these devices."""


class Heal(_Order, frozen=True, tag="heal"):
    """End every fault of answers, echo, frozen sensors, jams, absences and wrong models."""


class Unplug(_Order, frozen=True, tag="unplug"):
    """Pull the serial adapter."""


class Replug(_Order, frozen=True, tag="replug"):
    """Plug the serial adapter in again."""


class HangUp(_Order, frozen=True, kw_only=True, tag="hang_up"):
    """A controller disconnects its clients of one kind; they may connect again."""

    kind: Literal["rtde", "dashboard", "script"]


class Local(_Order, frozen=True, kw_only=True, tag="local"):
    """A controller is in local control: it takes no orders from the network. With ``on`` false it takes them."""

    on: bool = True


class BusOff(_Devices, frozen=True, kw_only=True, tag="bus_off"):
    """CAN controllers go bus-off: devices', or without `ids` the adapter's. With ``on`` false they start again."""

    on: bool = True


class Absent(_Devices, frozen=True, kw_only=True, tag="absent"):
    """Devices are off the bus: they neither receive nor answer. With ``on`` false they are back."""

    on: bool = True
    nth: Annotated[int, Meta(ge=1)] | None = None
    """Only the first, second, ... device of the bus, to distinguish two of one id."""


class Freeze(_Devices, frozen=True, kw_only=True, tag="freeze"):
    """The measured position is frozen although the shaft moves; with `tick`, the device's clock as well."""

    on: bool = True
    tick: bool = False


class Jam(_Devices, frozen=True, kw_only=True, tag="jam"):
    """The shaft is jammed; after a second of pushing against that, the device has an overload."""

    on: bool = True


class WrongModel(_Devices, frozen=True, kw_only=True, tag="wrong_model"):
    """Devices report another model number, as after a swap; in a gripper's place is one without its registers."""

    number: Annotated[int, Meta(ge=0, le=65_535)]


class BrownOut(_Devices, frozen=True, kw_only=True, tag="brown_out"):
    """The supply dips: RAM at its defaults, torque off, EEPROM kept."""

    zero: Literal["kept", "turn", "lost"] = "kept"
    """Of a motor on a CAN bus: its zero is kept, kept within a turn of the motor, or lost, so that it reads 0."""


class HardwareFault(_Devices, frozen=True, kw_only=True, tag="hardware_fault"):
    """Latch bits of the hardware error register: 4 overheating, 32 overload, ...; of a gripper, its fault number."""

    bits: Byte = 0x20


class Emergency(_Devices, frozen=True, kw_only=True, tag="emergency"):
    """CAN drives fail with an error code, such as 4310h: too hot. With ``lasting`` it cannot be reset until healed."""

    code: Annotated[int, Meta(ge=0x1000, le=0xFFFF)]
    lasting: bool = False


class Supply(_Devices, frozen=True, kw_only=True, tag="supply"):
    """Set the measured supply voltage and temperature of devices; outside their limits they shut down."""

    voltage_v: Annotated[float, Meta(ge=0, le=100)] | None = None
    temperature_c: Byte | None = None


class Place(_Devices, frozen=True, kw_only=True, tag="place"):
    """Turn shafts by hand, to a position in counts."""

    counts: Annotated[int, Meta(ge=-1_048_575, le=1_048_575)]


class Put(_Devices, frozen=True, kw_only=True, tag="put"):
    """Put an object between a gripper's fingers; without a width, take it away."""

    width_m: Annotated[float, Meta(ge=0, le=1)] | None = None
    stiffness_n_m: Annotated[float, Meta(gt=0)] = 50_000.0
    """Stiffness of the object in N/m."""
    inside: bool = False
    """The object is hollow, and the fingers meet it when they open."""


Command = (
    Absent
    | BadCrc
    | BrownOut
    | BusOff
    | Dribble
    | Duplicate
    | Echo
    | Emergency
    | Freeze
    | Garbage
    | HangUp
    | HardwareFault
    | Heal
    | Jam
    | Late
    | Local
    | Mute
    | Place
    | Put
    | Replug
    | Supply
    | Truncate
    | Unmute
    | Unplug
    | WrongModel
)


def kinds_of(union: object) -> dict[str, type[Command]]:
    """The values of a command's ``do``, and the struct of each."""
    kinds: tuple[type[Command], ...] = getattr(union, "__args__", ())
    return {str(kind.__struct_config__.tag): kind for kind in kinds}
