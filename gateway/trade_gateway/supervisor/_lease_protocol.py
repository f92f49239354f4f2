"""Both ends of a lease: the gateway that requests a container, and its standby."""

import math
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import msgspec

from trade import Container, Handle, LoadInfo, Run, where
from trade.errors import AccessDenied, ConfigurationError, NoSuchService, TradeError
from trade_gateway.config._children import Child
from trade_gateway.process._kill_timer import TimerLease, uptime_s
from trade_gateway.supervisor._host_loads import HostLoads
from trade_gateway.supervisor._lease import Arbiter, Holder, Lease
from trade_gateway.supervisor._objects import GROUP
from trade_gateway.supervisor._single_instance import is_free
from trade_gateway.supervisor._store import StateStore

_KEEP_S: Final = 5.0
"""How long the arbiter may take to save states, in seconds."""
_MOST_BYTES: Final = 16 * 1024 * 1024
"""The limit of the states of one container, in bytes."""
_MEASURE_EVERY_S: Final = 2.0
_HERE: Final = ""
"""This host, among the names of other gateways."""
_LOOK_EVERY_S: Final = 0.25
"""How often to check whether the previous process has ended, in seconds."""

Keep = Callable[[Mapping[str, Any]], bool]
"""Saves states; returns whether they are on disk."""


class LeaseEnd(Protocol):
    """The supervisor's view of a lease; used only on its thread, except the results of `load` and `keep`."""

    lock: Path
    """The lock file that its process holds for its life."""

    @property
    def why(self) -> str:
        """Why the container may not run here."""
        ...

    @property
    def term(self) -> TimerLease | None:
        """How long the container may run; None: as long as this gateway has it."""
        ...

    @property
    def due(self) -> float:
        """When to `look` again, by `uptime_s`."""
        ...

    @property
    def keeps(self) -> bool:
        """Whether the container's states can be saved now."""
        ...

    def update(self, *, alive: bool, wanted: bool) -> bool:
        """Does what is due; returns whether the container may run here.

        Args:
            alive: whether the container has a process.
            wanted: whether it would run here with a lease.
        """
        ...

    def load(self) -> dict[str, Any]:
        """Returns the states with which it starts."""
        ...

    def keep(self) -> Keep:
        """Returns the function that saves states read from now on."""
        ...


class LeaseHolder:
    """The end that requests a lease.

    Args:
        child: the container.
        container: returns the container that requests; it may change.
        run_on_supervisor: runs a function on the supervisor's thread.
        report: called with a problem of saving, and with its end.
        lock: see `Leased`.
    """

    def __init__(
        self,
        child: Child,
        container: Callable[[], Container],
        run_on_supervisor: Callable[[Callable[[], None]], None],
        report: Callable[[str], None],
        lock: Path,
    ) -> None:
        self.lock = lock
        self._name = child.name
        self._from = child.terms.lease_from
        self._container = container
        self._run_on_supervisor = run_on_supervisor
        self._report = report
        self._holder = Holder(uptime_s(), self._from)
        self._states: dict[str, Any] = {}
        self._states_turn = ""
        """The turn in which these states were received."""
        self._number = 0
        self._trouble = ""

    @property
    def why(self) -> str:
        return f"no lease: {self._holder.why}" if self._holder.why else ""

    @property
    def term(self) -> TimerLease | None:
        return self._holder.term

    @property
    def due(self) -> float:
        return self._holder.due

    @property
    def keeps(self) -> bool:
        return self._holder.keeps(uptime_s())

    def update(self, *, alive: bool, wanted: bool) -> bool:
        now, holder = uptime_s(), self._holder
        if holder.asks(now) and wanted:
            self._ask(now, holder.turn)
        if not holder.held(now):
            self._states_turn = ""
            return False
        if not self._states_turn:
            self._states_turn, self._states = holder.turn, _decoded(holder.states)
        return alive or is_free(self.lock)

    def load(self) -> dict[str, Any]:
        return dict(self._states)

    def keep(self) -> Keep:
        self._number += 1
        return partial(self._keep, self._states, self._holder.turn, self._number)

    def _keep(self, known: dict[str, Any], turn: str, number: int, states: Mapping[str, Any]) -> bool:
        known.update(states)
        try:
            data = msgspec.msgpack.encode(states)
            if len(data) > _MOST_BYTES:
                raise ConfigurationError(where=self._name, problem=f"its states take more than {_MOST_BYTES} bytes")
            keep = self._function("keep_child").with_(deadline_s=_KEEP_S)
            kept = bool(turn) and keep(self._name, self._container().name, turn, number, data)
        except Exception as error:  # noqa: BLE001 - the container continues after any error
            self._say(str(error))
            return False
        self._say("" if kept else f"{self._from} does not keep it")
        return kept

    def _say(self, trouble: str) -> None:
        if bool(trouble) != bool(self._trouble):
            what = (
                f"is not saved: {trouble}; the container continues" if trouble else f"is saved again, by {self._from}"
            )
            self._report(f"the state of {self._name} {what}")
        self._trouble = trouble

    def _ask(self, now: float, turn: str) -> None:
        try:
            ask = self._function("lease_child").with_(deadline_s=self._holder.within_s)
            run = ask.start(self._name, self._container().name, turn)
        except TradeError as error:
            seen = not isinstance(error, NoSuchService)
            self._holder.unanswered(str(error) if seen else f"{self._from} is not visible")
            return
        run.add_done_callback(lambda run: self._run_on_supervisor(partial(self._answered, now, turn, run)))

    def _answered(self, now: float, turn: str, run: Run) -> None:
        error = run.exception(0)
        if error is not None:
            self._holder.unanswered(f"{self._from} does not answer: {error}")
        else:
            self._holder.answered(now, turn, run.result(0))

    def _function(self, name: str) -> Handle:
        container = self._container()
        for found in container.services(where(name=name, group=GROUP, container=self._from)):
            if container.settings.tls is None or found.key.address.identity == self._from:
                return found
        raise NoSuchService(constraint=f"{name} of {self._from}")


class Standby:
    """The standby's end: gives leases, and runs the container while the other gateway has none.

    Args:
        child: the container.
        container: returns the gateway's container.
        run_on_supervisor: runs a function on the supervisor's thread.
        store: the store of states.
        lock: see `Leased`.
    """

    def __init__(
        self,
        child: Child,
        container: Callable[[], Container],
        run_on_supervisor: Callable[[Callable[[], None]], None],
        store: StateStore,
        lock: Path,
    ) -> None:
        self.lock = lock
        self._name = child.name
        self._other_gateways = child.terms.askers
        self._container = container
        self._run_on_supervisor = run_on_supervisor
        self._store = store
        self._move_above: float | None = None
        self._loads = HostLoads()
        self._measure_at = math.inf
        self._lease_s = 0.0
        self._longest_s = 0.0
        """The longest lease ever given, from the store."""
        self._guard = threading.Lock()
        """Guards the arbiter and the number of the last save."""
        known = store.load(self._own).get("holder", "")
        self._arbiter = Arbiter(
            self._other_gateways, secrets.token_hex(4), known if known in self._other_gateways else ""
        )
        self._saved = 0
        self._look_at = 0.0
        self.set_children(child)

    # --- on the supervisor's thread

    def set_children(self, child: Child) -> None:
        """Applies the lease time and the load of the container's table from now on."""
        lease_s, self._move_above = child.terms.lease_s, child.terms.move_above
        self._measure_at = math.inf if self._move_above is None else min(self._measure_at, uptime_s())
        known_s = max(self._longest_s, self._store.load(self._own).get("longest_s", 0.0))
        if lease_s > known_s:
            self._store.save(self._own, {"longest_s": lease_s})
        self._lease_s, self._longest_s = lease_s, max(lease_s, known_s)

    @property
    def _own(self) -> str:
        """The name of the lease's own rows in the store; no container has a space in its name."""
        return f"{self._name} leases"

    @property
    def why(self) -> str:
        return self._arbiter.why

    @property
    def term(self) -> None:
        return None

    @property
    def due(self) -> float:
        return min(self._look_at, self._measure_at, self._arbiter.due)

    @property
    def keeps(self) -> bool:
        return True

    def update(self, *, alive: bool, wanted: bool) -> bool:  # noqa: ARG002 - one given up here runs nowhere
        ended, now = not alive and is_free(self.lock), uptime_s()
        with self._guard:
            if ended:
                self._arbiter.ended(now, self._longest_s)
            self._arbiter.take_if_free(now)
            mine, handing = self._arbiter.mine, self._arbiter.handing
        self._look_at = now + _LOOK_EVERY_S if mine and not alive and not ended else math.inf
        if self._move_above is not None and now >= self._measure_at:
            self._measure_at = now + _MEASURE_EVERY_S
            self._measure(now)
            self._balance(now, self._move_above)
        return mine and not handing and (alive or ended)

    def load(self) -> dict[str, Any]:
        return self._store.load(self._name)

    def keep(self) -> Keep:
        return partial(self._store.save, self._name)

    def _measure(self, now: float) -> None:
        """Asks the other gateways for the load of their hosts, and notes this one's."""
        container = self._container()
        self._note_load(_HERE, now, container.system.load())
        for handle in container.services(where(name="load", group=GROUP)):
            address, certified = handle.key.address, container.settings.tls is not None
            gateway = address.container
            if gateway in self._other_gateways and (not certified or address.identity == gateway):
                with suppress(TradeError):
                    run = handle.with_(deadline_s=_MEASURE_EVERY_S).start()
                    run.add_done_callback(partial(self._answered, gateway, now))

    def _answered(self, gateway: str, now: float, run: Run) -> None:
        if run.exception(0) is None:
            self._run_on_supervisor(partial(self._note_load, gateway, now, run.result(0)))

    def _note_load(self, host: str, now: float, load: LoadInfo) -> None:
        if load.host_cpu_percent is not None:
            self._loads.note(host, load.host_cpu_percent / 100, now)

    def _balance(self, now: float, above: float) -> None:
        """Begins to move the container to the least loaded host, if its own one is too busy."""
        with self._guard:
            arbiter = self._arbiter
            asking = {gateway for gateway, at in arbiter.asked_at.items() if now - at <= self._lease_s}
            here = _HERE if arbiter.mine else arbiter.holder
            if arbiter.handing or arbiter.moves_to is not None or not (arbiter.mine or arbiter.turn):
                return
            to = self._loads.choice(here, {_HERE, *asking}, above, now)
            if to is not None:
                arbiter.move("" if to == _HERE else to)

    # --- from other threads

    def lease(self, caller: str | None, gateway: str, turn: str) -> Lease:
        """Handles a request of the other gateway; ``caller`` is None without certificates. Raises AccessDenied."""
        self._check(caller, gateway)
        with self._guard:
            arbiter, before = self._arbiter, self._arbiter.holder
            given = arbiter.request(uptime_s(), gateway, turn, self._lease_s)
            new_turn, moves_to, leave = arbiter.turn, arbiter.moves_to, before == gateway and bool(turn)
            if given and new_turn != turn:
                self._saved = 0
        if not given and moves_to is not None:
            return Lease("", why=f"it moves to {moves_to or 'the standby'}", leave=leave)
        if not given:
            return Lease("", why="the standby has it" if arbiter.mine else f"{before} may have it")
        if before != gateway and len(self._other_gateways) > 1 and not self._store.save(self._own, {"holder": gateway}):
            return Lease("", why="the standby cannot write down who has it")
        states = b"" if new_turn == turn else msgspec.msgpack.encode(self.load())
        return Lease(new_turn, self._lease_s, states=states)

    def keep_for(self, caller: str | None, gateway: str, turn: str, number: int, states: bytes) -> bool:
        """Saves the states of the other gateway's container, unless they are late; returns whether they are on disk.

        Raises:
            AccessDenied: the caller is another gateway.
            ConfigurationError: the states are invalid or too large.
        """
        self._check(caller, gateway)
        problem = f"more than {_MOST_BYTES} bytes" if len(states) > _MOST_BYTES else ""
        try:
            known = {} if problem else msgspec.msgpack.decode(states, type=dict[str, Any])
        except ValueError as error:
            known, problem = {}, str(error)
        if problem:
            raise ConfigurationError(where=f"states of {self._name}", problem=problem)
        return self._store.save(self._name, known, lambda: self._is_newest(turn, number))

    def hand_back(self) -> None:
        """Saves and ends the container here, for the other gateway. Raises ConfigurationError if that is absent."""
        with self._guard:
            if not self._arbiter.mine:
                problem = f"it does not run here: {self._arbiter.why}"
            elif uptime_s() - max(self._arbiter.asked_at.values(), default=-math.inf) > self._lease_s:
                names = " and ".join(self._other_gateways)
                problem = f"{names} has not requested it for {self._lease_s:g} s; is it up and connected?"
            else:
                self._arbiter.hand_back()
                problem = ""
        if problem:
            raise ConfigurationError(where=f"container {self._name}", problem=problem)
        self._run_on_supervisor(lambda: None)

    def _is_newest(self, turn: str, number: int) -> bool:
        with self._guard:
            if not turn or turn != self._arbiter.turn or number <= self._saved:
                return False
            self._saved = number
            return True

    def _check(self, caller: str | None, gateway: str) -> None:
        asks = gateway if caller is None else caller
        if asks != gateway or asks not in self._other_gateways:
            rule = f"only {' and '.join(self._other_gateways)} may request it"
            raise AccessDenied(who=asks, verb="call", what=f"the lease of {self._name}", rule=rule)


def _decoded(states: bytes) -> dict[str, Any]:
    return msgspec.msgpack.decode(states, type=dict[str, Any]) if states else {}
