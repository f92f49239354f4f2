"""The state machine of a drive (CiA 402-2, 6.4): how commands and faults change its state, and how motion ends."""

from collections.abc import Callable
from enum import Enum, IntEnum
from math import inf
from typing import Final, Protocol

from trade_hil_sim.mechanics._shaft import Shaft

from ._modes import Modes
from ._store import Store


class State(IntEnum):
    """States, as the bits of the statusword that distinguish them."""

    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """Commands in the lower bits of a controlword."""

    DISABLE_VOLTAGE = "disable_voltage"
    QUICK_STOP = "quick_stop"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch_on"
    ENABLE_OPERATION = "enable_operation"


def command(controlword: int) -> Command:
    """The command in a controlword."""
    match controlword & 0b1111:
        case bits if not bits & 2:
            return Command.DISABLE_VOLTAGE
        case bits if not bits & 4:
            return Command.QUICK_STOP
        case bits if not bits & 1:
            return Command.SHUTDOWN
        case bits if not bits & 8:
            return Command.SWITCH_ON
        case _:
            return Command.ENABLE_OPERATION


_OFF: Final = State.SWITCH_ON_DISABLED
_TRANSITIONS: Final = {
    State.SWITCH_ON_DISABLED: {Command.SHUTDOWN: State.READY_TO_SWITCH_ON},
    State.READY_TO_SWITCH_ON: {
        Command.SWITCH_ON: State.SWITCHED_ON,
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,  # 3 and 4 at once
        Command.QUICK_STOP: _OFF,
        Command.DISABLE_VOLTAGE: _OFF,
    },
    State.SWITCHED_ON: {
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.QUICK_STOP: _OFF,
        Command.DISABLE_VOLTAGE: _OFF,
    },
    State.OPERATION_ENABLED: {
        Command.SWITCH_ON: State.SWITCHED_ON,
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,
        Command.QUICK_STOP: State.QUICK_STOP_ACTIVE,
        Command.DISABLE_VOLTAGE: _OFF,
    },
    State.QUICK_STOP_ACTIVE: {
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.DISABLE_VOLTAGE: _OFF,
    },
}


def next_state(state: State, wanted: Command) -> State:
    """The next state for a command; other states ignore it."""
    return _TRANSITIONS.get(state, {}).get(wanted, state)


FAULT_RESET: Final = 1 << 7
COAST: Final = 1_000_000.0
"""Counts/s^2 at which a shaft without power comes to rest."""
STAYING: Final = 5
"""Quick stop options of at least this value stay in quick stop active."""
POWERED: Final = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE})


class Emergencies(Protocol):
    """Reports errors to the network."""

    def emergency(self, code: int, t: float) -> None:
        """Report an error."""
        ...

    def emergency_over(self, t: float) -> None:
        """Report that no error is left."""
        ...


class Machine:
    """The state machine at work.

    Args:
        store: objects of the drive.
        shaft: what moves.
        modes: what moves it while operation is enabled.
        note: puts an event into the log.
    """

    def __init__(self, store: Store, shaft: Shaft, modes: Modes, note: Callable[[str, float, str], None]) -> None:
        self._store, self._shaft, self._modes, self._note = store, shaft, modes, note
        self.state = State.SWITCH_ON_DISABLED
        self.causes = set[int]()
        """Errors that cannot be reset because they last."""
        self._then: State | None = None
        """The next state once the shaft is at rest."""

    @property
    def powered(self) -> bool:
        """Whether the shaft is driven or held."""
        return self.state in POWERED

    def due(self, t: float) -> float:
        """When `advance` should be called next; the ends of motions are watched elsewhere."""
        return t if self._then is not None and not self._shaft.moving(t) else inf

    def advance(self, t: float) -> None:
        """Enter the next state once the shaft is at rest."""
        if self._then is not None and not self._shaft.moving(t):
            self.enter(self._then, t)

    def obey(self, before: int, t: float, emergencies: Emergencies) -> None:
        """Apply the controlword; `before` is its previous value."""
        now = self._store.get("controlword")
        if self.state is State.FAULT:
            if now & FAULT_RESET and not before & FAULT_RESET:
                self._reset_fault(t, emergencies)
        elif self.state is not State.FAULT_REACTION_ACTIVE:
            self.lead(command(now), t)

    def _reset_fault(self, t: float, emergencies: Emergencies) -> None:
        if self.causes:
            self._note("refused", t, f"error {min(self.causes):04X}h lasts")
            return
        self._store.set("error_code", 0)
        self.enter(State.SWITCH_ON_DISABLED, t)
        emergencies.emergency_over(t)

    def lead(self, wanted: Command, t: float) -> None:
        """Carry out a command of the state machine."""
        state = next_state(self.state, wanted)
        if state is self.state:
            if self._then is not None and state is State.OPERATION_ENABLED:  # leaving had begun
                self._then = None
                self._modes.enable(t)
            return
        stays = self._store.get("quick_stop_option") >= STAYING
        if self.state is State.QUICK_STOP_ACTIVE and state is State.OPERATION_ENABLED and not stays:
            return
        if self.state is State.OPERATION_ENABLED and wanted is not Command.DISABLE_VOLTAGE:
            self._leave_operation(wanted, state, t)
        else:
            self.enter(state, t)

    def _leave_operation(self, wanted: Command, state: State, t: float) -> None:
        """Leave operation, after slowing down if the option for it says so."""
        if wanted is Command.QUICK_STOP:
            self._quick_stop(t)
            return
        option = "shutdown_option" if wanted is Command.SHUTDOWN else "disable_operation_option"
        if self._store.get(option) and self._shaft.moving(t):
            self._then = state
            self._modes.stop(t, self._store.rate("profile_deceleration"))
        else:
            self.enter(state, t)

    def _quick_stop(self, t: float) -> None:
        option = self._store.get("quick_stop_option")
        if option == 0:
            self.enter(State.SWITCH_ON_DISABLED, t)
            return
        self.enter(State.QUICK_STOP_ACTIVE, t)
        slow = option in {1, STAYING}
        self._modes.stop(t, self._store.rate("profile_deceleration" if slow else "quick_stop_deceleration"))
        if option < STAYING:
            self._then = State.SWITCH_ON_DISABLED

    def enter(self, state: State, t: float) -> None:
        """Enter a state."""
        had_power, has_power = self.state in POWERED, state in POWERED
        changed, self.state = state is not self.state, state
        self._then = None
        if state is State.OPERATION_ENABLED:
            self._modes.enable(t)
        else:
            self._modes.disable()
        if changed:
            self._note("state", t, state.name.lower())
        if had_power != has_power:
            self._note("torque_on" if has_power else "torque_off", t, "")
        if not has_power:
            self._shaft.forget(t)
            self._modes.stop(t, COAST)

    def fail(self, code: int, t: float, emergencies: Emergencies | None) -> None:
        """Fail: react as object 605Eh says, then stay in fault until reset. Without `emergencies`, report nothing."""
        self._store.set("error_code", code)
        self._note("shutdown", t, f"error {code:04X}h")
        if emergencies is not None:
            emergencies.emergency(code, t)
        if self.state is State.FAULT:
            return
        option = self._store.get("fault_reaction_option")
        if self.state in POWERED and option:
            self.enter(State.FAULT_REACTION_ACTIVE, t)
            slow = option == 1
            self._modes.stop(t, self._store.rate("profile_deceleration" if slow else "quick_stop_deceleration"))
            self._then = State.FAULT
        else:
            self.enter(State.FAULT, t)
