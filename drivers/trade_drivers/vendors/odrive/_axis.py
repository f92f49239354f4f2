"""The state of one axis on the bus thread, from its frames, and faults that forbid motion."""

from collections.abc import Callable, Sequence
from math import isfinite
from struct import error as BadLength  # noqa: N812 - what unpacking raises for another number of bytes
from typing import Final

from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints.can import MotorAxis, resolution_of
from trade_drivers.vendors.odrive._frames import Health, Heartbeat, Version, two_floats
from trade_drivers.vendors.odrive._table import MODELS, Command, Errors, Result, State
from trade_robotfile import Joint

COUNTS_PER_TURN: Final = 1 << 16
"""Counts per turn of the motor in this driver, finer than any encoder; frames contain turns."""


class OdriveAxis(MotorAxis):
    """One axis."""

    def __init__(self, name: str, bus: str, joint: Joint, rate_hz: float, coupled: Sequence[str] = ()) -> None:
        super().__init__(name, bus, joint, resolution_of(joint, rate_hz, COUNTS_PER_TURN), coupled)
        self.model = MODELS[joint.model]
        self.version: Version | None = None
        """The reported identity; None until it has answered."""
        self.identity: Version | None = None
        """The identity when it was attached."""
        self.state_now: int | None = None
        self.errors = Errors(0)
        self.disarmed_by = Errors(0)
        self.result = 0
        self.health_ns = 0
        """When it last reported its errors, requested or not."""
        self.proven = False
        """True after its watchdog was tested."""
        self.asked_after = 0
        """The last requested health value."""
        self._amperes = 0.0
        self._celsius: float | None = None
        self._volts: float | None = None

    def listeners(self, clock: Callable[[], int]) -> dict[Command, Callable[[bytes], None]]:
        """Returns the handlers of its frames, which ignore truncated frames."""

        def sound(take: Callable[[bytes], None]) -> Callable[[bytes], None]:
            def taken(data: bytes) -> None:
                try:
                    take(data)
                except BadLength:
                    return

            return taken

        return {
            Command.VERSION: sound(self._take_version),
            Command.HEARTBEAT: sound(lambda data: self._take_heartbeat(data, clock())),
            Command.ERRORS: sound(lambda data: self._take_errors(data, clock())),
            Command.ESTIMATES: sound(lambda data: self._take_estimates(data, clock())),
            Command.CURRENTS: sound(self._take_currents),
            Command.TEMPERATURES: sound(self._take_temperatures),
            Command.SUPPLY: sound(self._take_supply),
        }

    # --- received frames

    def _take_version(self, data: bytes) -> None:
        self.version = Version.decode(data)

    def _take_heartbeat(self, data: bytes, now_ns: int) -> None:
        beat = Heartbeat.decode(data)
        self.state_now, self.result, self.errors = beat.state, beat.result, beat.errors
        self.beat_ns = self.health_ns = now_ns
        self._judge()

    def _take_errors(self, data: bytes, now_ns: int) -> None:
        self.errors, self.disarmed_by = Health.decode(data)
        self.health_ns = now_ns
        if self.errors:
            self._judge()

    def _take_estimates(self, data: bytes, now_ns: int) -> None:
        turns, turns_s = two_floats(data)
        self.measured_at(turns * COUNTS_PER_TURN, turns_s * COUNTS_PER_TURN, 0.0, now_ns)

    def _take_currents(self, data: bytes) -> None:
        _, self._amperes = two_floats(data)

    def _take_temperatures(self, data: bytes) -> None:
        known = [value for value in two_floats(data) if isfinite(value)]  # not every motor has a thermistor
        self._celsius = max(known) if known else None

    def _take_supply(self, data: bytes) -> None:
        self._volts, _ = two_floats(data)

    def _judge(self) -> None:
        if self.unfed:
            return  # the watchdog test handles this itself
        if self.errors:
            self.latch(f"error: {self.errors.text}")
        elif self.ready and not self.torque:
            why = f": {self.disarmed_by.text}" if self.disarmed_by else "; has it restarted?"
            self.latch(f"its torque went off{why}")

    # --- state

    @property
    def torque(self) -> bool | None:
        return None if self.state_now is None else self.state_now != State.IDLE

    @property
    def armed(self) -> bool:
        """Whether it follows its inputs."""
        return self.state_now == State.CLOSED_LOOP

    @property
    def refusal(self) -> str:
        """Why it does not arm."""
        if self.errors:
            return self.errors.text
        known = {result.value: result.name.lower().replace("_", " ") for result in Result}
        return f"its last change of state ended with {known.get(self.result, self.result)!r}"

    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        sign = -1 if self.joint.reversed else 1
        return self.measured(
            self.fresh(now_ns, stale_after_ns),
            now_ns,
            load=max(-1.0, min(1.0, sign * self._amperes / self.model.peak_a)) if isfinite(self._amperes) else 0.0,
            enabled=self.armed and not self.unfed,
            temperature_c=self._celsius,
            voltage_v=self._volts,
        )
