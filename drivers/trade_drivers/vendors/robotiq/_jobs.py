"""Jobs of services for the bus thread: activation, moves, stops, and clearing faults."""

from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import DeadlineExceeded, DeviceSilent, MotionStopped, OutcomeUnknown, TradeError
from trade_drivers.bus._attempts import attempts
from trade_drivers.bus._gate import Command, Terms
from trade_drivers.bus._jobs import Gate, NoAnswer, Refused, Steps
from trade_drivers.vendors.robotiq import _table as table
from trade_drivers.vendors.robotiq._gripper_state import GripperDevice
from trade_drivers.vendors.robotiq._table import Contact, Status

if TYPE_CHECKING:
    from trade_drivers.vendors.robotiq._cycle import Exchange

_RESET_NS: Final = 1_000_000_000
_TAKEN_NS: Final = 500_000_000
_STUCK_S: Final = 0.5
_ACTIVATION_S: Final = 10.0
_NEAR_COUNTS: Final = 8
_MOST_PER_CYCLE_S: Final = 0.1


class GripperCommand(Command[GripperDevice, "Exchange"]):
    """A command with exchanges within a retry budget."""

    @property
    def hand(self) -> GripperDevice:
        """The gripper."""
        return self.devices[0]

    def tell(self, values: Sequence[int], *, out: Gate | None = None) -> Steps:
        """Writes the command registers, within the retry budget.

        Args:
            values: the values of the three registers.
            out: called immediately before the first bytes are sent.
        """

        def gate() -> None:
            self.gate()
            if out is not None:
                out()

        yield from _try(self, lambda: self.exchange.write(self.hand, values, gate))

    def look(self) -> Generator[None, None, Status]:
        """Reads the gripper's state now."""
        yield from _try(self, lambda: self.exchange.read(self.hand))
        return self.hand.fresh(self.exchange.clock(), self.exchange.stale_after_ns)

    def resetting(self) -> Steps:
        """Clears the activation and the faults; nothing moves."""
        exchange, hand = self.exchange, self.hand
        self.gate()
        exchange.end_motion(hand, f"{self.service} was called")
        yield from self.tell(table.RESET)
        until_ns = exchange.clock() + _RESET_NS
        while not (status := (yield from self.look())).reset or table.fault_text(status.fault):
            if exchange.clock() > until_ns:
                raise hand.faulty(hand.fault or "it was reset, but keeps its activation")
        hand.fault = ""


class ClearFault(GripperCommand):
    """Resets the device; nothing moves."""

    def steps(self) -> Steps:
        _require_answering(self)
        yield from self.resetting()


class Motion(GripperCommand):
    """A command that moves the fingers, and is watched until it ends."""

    def __init__(self, exchange: "Exchange", hands: Sequence[GripperDevice], terms: Terms) -> None:
        super().__init__(exchange, hands, terms)
        self._began_ns = self._watched_ns = 0
        self._position = -1
        self._waiting_s = 0.0
        self._patience_s = 0.0

    def launching(self, values: Sequence[int], patience_s: float) -> Steps:
        """Writes the command that moves the fingers, and starts to watch them with its first byte."""
        try:
            yield from self.tell(values, out=lambda: self.exchange.take_over(self))
        except TradeError as problem:
            self.exchange.release(self, problem)
            raise
        self.note("wrote goal")
        self._patience_s = patience_s
        self._began_ns = self._watched_ns = self.exchange.clock()

    def done_stepping(self) -> None:
        """Does nothing: the motion is watched until it ends. (It has already ended if it was refused.)"""

    def watch(self, now_ns: int) -> None:
        """Checks the newest measurement, and ends the motion if it is over or must not continue."""
        if not self._began_ns:
            return
        ending = self._trouble(now_ns)
        sample = self.hand.sample
        if ending is None and sample is not None and sample.at_ns > self._began_ns:
            if self.arrived(sample):
                self.exchange.release(self, None)
                return
            ending = self.stuck(sample)
        if ending is not None:
            self.exchange.release(self, ending)

    def arrived(self, sample: Status) -> bool:
        """Returns whether it is over."""
        raise NotImplementedError

    def stuck(self, sample: Status) -> TradeError | None:
        """Returns the error that prevents its end. Only time between measurements counts, as the rest is unknown."""
        elapsed_s = min((sample.at_ns - self._watched_ns) / 1e9, _MOST_PER_CYCLE_S)
        self._watched_ns = sample.at_ns
        self._waiting_s = self._waiting_s + elapsed_s if sample.position == self._position else 0.0
        self._position = sample.position
        self._patience_s -= elapsed_s
        if self._patience_s > 0 and self._waiting_s <= _STUCK_S:
            return None
        self.hand.fault = "it says that it moves, but its fingers stand: its position sensor may be broken"
        return self.hand.faulty()

    def _trouble(self, now_ns: int) -> TradeError | None:
        hand = self.hand
        if hand.silent or hand.age_ns(now_ns) > self.exchange.stale_after_ns:
            return hand.deaf(now_ns)
        if hand.fault:
            return hand.faulty()
        if self.until_ns is not None and now_ns >= self.until_ns:
            return MotionStopped(device=hand.name, reason="its call reached its deadline", late=True)
        return None


class Activate(Motion):
    """Moves the fingers to find their end stops."""

    def steps(self) -> Steps:
        _require_answering(self)
        status = yield from self.look()
        if status.activated and not self.hand.fault:
            self.finish()
            return
        yield from self.resetting()
        yield from self.launching(table.ACTIVATE, _ACTIVATION_S)

    def arrived(self, sample: Status) -> bool:
        return sample.activated and self.hand.still > 0

    def stuck(self, sample: Status) -> TradeError | None:
        if sample.reset and sample.at_ns - self._began_ns > _TAKEN_NS:
            return self.hand.inactive("it did not begin its activation, or lost its power in the middle of it")
        problem = super().stuck(sample)
        if problem is not None:
            self.hand.fault = "its activation does not end: something may be in the way of its fingers"
            return self.hand.faulty()
        return None


class Move(Motion):
    """Moves the fingers to a width, or until they meet an object."""

    def __init__(
        self, exchange: "Exchange", hands: Sequence[GripperDevice], registers: tuple[int, int, int], terms: Terms
    ) -> None:
        super().__init__(exchange, hands, terms)
        self._registers = registers
        self._goal = registers[1]

    def steps(self) -> Steps:
        hand, exchange = self.hand, self.exchange
        hand.check_usable(exchange.clock(), exchange.stale_after_ns)
        slowest_m_s, _ = hand.model.speeds_m_s
        yield from self.launching(self._registers, 1.0 + 2 * hand.model.stroke_m / slowest_m_s)
        hand.force_counts = self._registers[2] & 0xFF

    def arrived(self, sample: Status) -> bool:
        taken = sample.going and sample.echo == self._goal and sample.activated
        return taken and sample.contact != Contact.MOVING and self.hand.still > 0 and not self._elsewhere(sample)

    def _elsewhere(self, sample: Status) -> bool:
        """Returns whether it reports its goal as reached although it is elsewhere."""
        short = abs(sample.position - self.hand.model.expected(self._goal))
        return sample.contact == Contact.ARRIVED and short > _NEAR_COUNTS

    def stuck(self, sample: Status) -> TradeError | None:
        if not sample.activated:
            return self.hand.inactive("it has lost its activation; did its power fail?")
        if (sample.echo != self._goal or not sample.going) and sample.at_ns - self._began_ns > _TAKEN_NS:
            return self.hand.faulty("it does not take a command")
        return super().stuck(sample)


def _require_answering(job: GripperCommand) -> None:
    if job.hand.silent:
        raise job.hand.deaf(job.exchange.clock())


def _try(job: GripperCommand, act: Callable[[], None]) -> Steps:
    """Runs one exchange within the retry budget; a probe before each retry discards late answers."""
    exchange = job.exchange
    began_ns = exchange.clock()
    for attempt in attempts(exchange.clock, exchange.stale_after_ns):
        try:
            if attempt:
                exchange.probe(job.hand)
                yield
            act()
        except DeadlineExceeded as late:
            if attempt:  # an earlier attempt was sent, and its outcome is unknown
                raise OutcomeUnknown(service=late.service, deadline_s=late.deadline_s) from None
            raise
        except NoAnswer:
            yield
        except Refused as refused:
            raise job.hand.faulty(f"it is no 2F-85: {refused}") from None
        else:
            yield
            return
    waited_s = (exchange.clock() - began_ns) / 1e9
    raise DeviceSilent(device=job.hand.name, bus=job.hand.bus, waited_s=waited_s, reason=exchange.why_silent())
