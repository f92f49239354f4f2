"""Each scripted fault and order as a method, whoever carries it out."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Literal

from trade_hil_sim.faults import _faults as faults

__all__ = ["FaultMethods"]


class FaultMethods(ABC):
    """What can be done to simulated devices: a method for each fault, which makes the value and hands it to `do`."""

    @abstractmethod
    def do(self, command: faults.Command) -> None:
        """Carry out any command of the simulator."""

    # faults of answers

    def mute(
        self,
        ids: Iterable[int] | None = None,
        *,
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """Devices obey, but do not answer."""
        self.do(faults.Mute(ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count))

    def unmute(self, ids: Iterable[int] | None = None, *, bus: str | None = None) -> None:
        """End every mute of these devices."""
        self.do(faults.Unmute(ids=_ids(ids), bus=bus))

    def late(
        self,
        s: float,
        ids: Iterable[int] | None = None,
        *,
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """Answers come `s` seconds late."""
        self.do(faults.Late(s=s, ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count))

    def bad_crc(
        self,
        ids: Iterable[int] | None = None,
        *,
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """The last byte of answers is wrong. On a CAN bus: the frame is destroyed, and sent again."""
        self.do(faults.BadCrc(ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count))

    def truncate(
        self,
        ids: Iterable[int] | None = None,
        *,
        missing: int = 3,
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """Answers break off: the last `missing` bytes never come."""
        self.do(
            faults.Truncate(missing=missing, ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count)
        )

    def garbage(
        self,
        ids: Iterable[int] | None = None,
        *,
        hex: str = "fffffd00ff",  # noqa: A002 - as the fault has it
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """Noise comes before answers: these bytes, in hex."""
        self.do(faults.Garbage(hex=hex, ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count))

    def dribble(
        self,
        s: float,
        ids: Iterable[int] | None = None,
        *,
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """Answers come byte by byte, `s` seconds apart."""
        self.do(faults.Dribble(s=s, ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count))

    def duplicate(
        self,
        ids: Iterable[int] | None = None,
        *,
        bus: str | None = None,
        instruction: str | None = None,
        skip: int = 0,
        count: int | None = None,
    ) -> None:
        """Answers come twice."""
        self.do(faults.Duplicate(ids=_ids(ids), bus=bus, instruction=instruction, skip=skip, count=count))

    def heal(self, *, bus: str | None = None) -> None:
        """End every fault of answers, echo, frozen sensors, jams, absences and wrong models."""
        self.do(faults.Heal(bus=bus))

    # the line and the devices

    def unplug(self, bus: str | None = None) -> None:
        """Pull the serial adapter. The devices stay powered."""
        self.do(faults.Unplug(bus=bus))

    def replug(self, bus: str | None = None) -> None:
        """Plug the serial adapter in again; clients must open the port anew."""
        self.do(faults.Replug(bus=bus))

    def echo(self, *, on: bool = True, bus: str | None = None) -> None:
        """The adapter sends back what it hears; with `on` false it ends."""
        self.do(faults.Echo(on=on, bus=bus))

    def bus_off(self, ids: Iterable[int] | None = None, *, on: bool = True, bus: str | None = None) -> None:
        """CAN controllers of devices go bus-off, or without `ids` the adapter's; with `on` false they start again."""
        self.do(faults.BusOff(on=on, ids=_ids(ids), bus=bus))

    def hang_up(self, kind: Literal["rtde", "dashboard", "script"], *, bus: str | None = None) -> None:
        """A controller of an arm hangs up on its clients of one kind; they may connect again."""
        self.do(faults.HangUp(kind=kind, bus=bus))

    def local(self, *, on: bool = True, bus: str | None = None) -> None:
        """A controller of an arm is switched to local control, or with `on` false back."""
        self.do(faults.Local(on=on, bus=bus))

    def absent(
        self, ids: Iterable[int] | None = None, *, nth: int | None = None, on: bool = True, bus: str | None = None
    ) -> None:
        """Take devices off the bus, or only its `nth` one; with `on` false put them back."""
        self.do(faults.Absent(nth=nth, on=on, ids=_ids(ids), bus=bus))

    def brown_out(self, ids: Iterable[int] | None = None, *, bus: str | None = None) -> None:
        """Let the supply dip: RAM at its defaults, torque off."""
        self.do(faults.BrownOut(ids=_ids(ids), bus=bus))

    def hardware_fault(self, bits: int = 0x20, ids: Iterable[int] | None = None, *, bus: str | None = None) -> None:
        """Latch bits of the hardware error register; 32 is overload."""
        self.do(faults.HardwareFault(bits=bits, ids=_ids(ids), bus=bus))

    def emergency(
        self, code: int, ids: Iterable[int] | None = None, *, lasting: bool = False, bus: str | None = None
    ) -> None:
        """CAN drives fail with an error code; with `lasting` it cannot be reset until `heal`."""
        self.do(faults.Emergency(code=code, lasting=lasting, ids=_ids(ids), bus=bus))

    def freeze(
        self, ids: Iterable[int] | None = None, *, on: bool = True, tick: bool = False, bus: str | None = None
    ) -> None:
        """Let the measured position stand still, and with `tick` the device's clock."""
        self.do(faults.Freeze(on=on, tick=tick, ids=_ids(ids), bus=bus))

    def jam(self, ids: Iterable[int] | None = None, *, on: bool = True, bus: str | None = None) -> None:
        """Hold shafts fast, or with `on` false let them go; straining for a second is an overload."""
        self.do(faults.Jam(on=on, ids=_ids(ids), bus=bus))

    def wrong_model(self, number: int, ids: Iterable[int] | None = None, *, bus: str | None = None) -> None:
        """Devices report another model number, as after a swap."""
        self.do(faults.WrongModel(number=number, ids=_ids(ids), bus=bus))

    def supply(
        self,
        ids: Iterable[int] | None = None,
        *,
        voltage_v: float | None = None,
        temperature_c: int | None = None,
        bus: str | None = None,
    ) -> None:
        """Set what devices measure of their supply and housing; outside their limits they shut down."""
        self.do(faults.Supply(voltage_v=voltage_v, temperature_c=temperature_c, ids=_ids(ids), bus=bus))

    def place(self, counts: int, ids: Iterable[int] | None = None, *, bus: str | None = None) -> None:
        """Turn shafts by hand, to a position in counts."""
        self.do(faults.Place(counts=counts, ids=_ids(ids), bus=bus))

    def put(
        self,
        width_m: float | None = None,
        ids: Iterable[int] | None = None,
        *,
        stiffness_n_m: float = 50_000.0,
        inside: bool = False,
        bus: str | None = None,
    ) -> None:
        """Put an object between the fingers of grippers, or `inside` around them; without a width, take it away."""
        self.do(faults.Put(width_m=width_m, stiffness_n_m=stiffness_n_m, inside=inside, ids=_ids(ids), bus=bus))


def _ids(ids: Iterable[int] | None) -> tuple[int, ...] | None:
    return None if ids is None else tuple(ids)
