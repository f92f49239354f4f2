"""The supervisor: one thread that starts, checks, restarts and ends child processes.

It has over 400 lines, since all of them run on that thread and share its state.
"""

import contextlib
import math
import os
import selectors
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from msgspec import structs

from trade import Container, Handle, Run
from trade.errors import Busy, ConfigurationError, ServiceGone, TradeError
from trade.starting import Started
from trade_gateway.config._children import Child
from trade_gateway.process._kill_timer import TimerLease
from trade_gateway.supervisor._child_state import ChildInfo, News, Unit
from trade_gateway.supervisor._lease_protocol import LeaseEnd, LeaseHolder, Standby
from trade_gateway.supervisor._objects import CreatedObjects, furnish, save
from trade_gateway.supervisor._process import Process, rss_mb
from trade_gateway.supervisor._program_health import await_program, epochs_of, health_problem
from trade_gateway.supervisor._restart_policy import GRACE_S, SAVE_S, State, Transition
from trade_gateway.supervisor._single_instance import lock_of
from trade_gateway.supervisor._store import StateStore

_ENDS_S: Final = GRACE_S + SAVE_S + 5.0
"""How long one child may take to end, in seconds."""


class Supervisor:
    """Supervises the children that `set_children` names, until `close` ends them in reverse order.

    Args:
        container: returns the container that calls them; it may change.
        report: called with reports about them, on the supervisor's thread.
        folder: the folder for ``logs`` and for the states of providers.
        grace_s: how long a shutdown may take before SIGKILL, in seconds.
        clock: ``time.monotonic``; a test has its own clock and fake processes.
        launch: starts the process of a child.
        furnish: waits until the child is visible, and creates its objects.
    """

    def __init__(
        self,
        container: Callable[[], Container],
        report: Callable[[News], None],
        folder: Path,
        *,
        grace_s: float = GRACE_S,
        clock: Callable[[], float] | None = None,
        launch: Callable[[Child, Path, Path | None, TimerLease | None], Process] = Process,
        furnish: Callable[[Callable[[], Container], Child, Started, Mapping[str, Any]], CreatedObjects] = furnish,
    ) -> None:
        self._clock = clock or time.monotonic
        self._new_process = launch
        self._create_objects = furnish
        self._container = container
        self._report_to = report
        self._folder = folder
        self._grace_s = grace_s
        self._store = StateStore(folder / f"{container().name}.state.sqlite", self._complain)
        self._units: dict[str, Unit] = {}
        self._child_infos: tuple[ChildInfo, ...] = ()
        self._inbox: deque[Callable[[], None]] = deque()
        self._jobs: set[threading.Thread] = set()
        self._closing = False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._wake_read, selectors.EVENT_READ, self._drain_wake_pipe)
        self._thread = threading.Thread(target=self._run, name="trade-supervisor", daemon=True)
        self._thread.start()

    # --- from other threads

    def set_children(self, children: Sequence[Child]) -> None:
        """Sets the children, in start order; only those with a changed start are restarted."""
        self._post(partial(self._set_children, {child.name: child for child in children}))

    @property
    def alive(self) -> bool:
        """Whether the supervisor's thread runs."""
        return self._thread.is_alive()

    @property
    def certified(self) -> bool:
        """Whether links have certificates."""
        return self._container().settings.tls is not None

    def children(self) -> list[ChildInfo]:
        """Returns their states."""
        return [structs.replace(info, rss_mb=round(rss_mb(info.pid), 1)) for info in self._child_infos]

    def restart(self, name: str, requester: str) -> bool:
        """Restarts a child, also if it was given up; returns whether the name is known."""
        if all(info.name != name for info in self._child_infos):
            return False
        self._post(partial(self._restart, name, requester))
        return True

    def stop(self, name: str, requester: str) -> bool:
        """Ends a child until it is restarted by request; returns whether the name is known."""
        if all(info.name != name for info in self._child_infos):
            return False
        self._post(partial(self._stop, name, requester))
        return True

    def standby_of(self, name: str) -> Standby:
        """Returns the standby's end of a child's lease. Raises ConfigurationError if it has none."""
        unit = self._units.get(name)
        if unit is None or not isinstance(unit.lease, Standby):
            problem = f"this gateway is no standby for a container {name!r}; its table needs stands_in_for"
            raise ConfigurationError(where=f"container {name}", problem=problem)
        return unit.lease

    def leave(self) -> None:
        """Begins to end them, as `close` does, and does not wait."""
        self._post(self._close)

    def close(self) -> None:
        """Ends them in reverse order of their dependencies, after it saved their state. Idempotent."""
        if not self._thread.is_alive():
            return
        self.leave()
        self._thread.join(_ENDS_S * (len(self._units) + 1))
        for job in list(self._jobs):
            job.join(_ENDS_S)
        self._store.close()
        self._selector.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _post(self, function: Callable[[], None]) -> None:
        self._inbox.append(function)
        with contextlib.suppress(BlockingIOError, OSError):  # woken already, or closed
            os.write(self._wake_write, b"!")

    # --- the thread

    def _run(self) -> None:
        while not (self._closing and all(unit.has_ended for unit in self._units.values())):
            due_s = min((unit.due_s for unit in self._units.values()), default=math.inf)
            ready = self._selector.select(None if due_s == math.inf else max(0.0, due_s))
            for unit in list(self._units.values()):  # a child without a lease is not restarted
                self._by_lease(unit)
            for key, _ in ready:
                key.data()
            while self._inbox:
                self._inbox.popleft()()
            for unit in list(self._units.values()):
                self._look(unit, self._clock())
            self._child_infos = tuple(unit.info() for unit in self._units.values())

    def _drain_wake_pipe(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)

    def _by_lease(self, unit: Unit) -> bool:
        """Ends a child that may no longer run here; returns whether it may."""
        if unit.may_be_up():
            unit.send_lease()
            return True
        lease, now = unit.lease, self._clock()
        if lease is not None and unit.begun and not unit.given_up:
            unit.begun = False
            self._do(unit, unit.life.stop(now, lease.why, save=lease.keeps))
        return False

    def _look(self, unit: Unit, now: float) -> None:
        may_be_up = self._by_lease(unit)
        if unit.leaving:
            if not unit.life.alive or not self._needed(unit):
                self._do(unit, unit.life.stop(now, unit.leaving))
            if unit.has_ended and not self._closing:
                del self._units[unit.child.name]
        elif unit.to_begin and may_be_up and all(self._has_been_up(name) for name in unit.child.terms.after):
            unit.begun = True
            if unit.lease is not None:
                self._report(unit, f"{unit.child.name} runs on this host now")
            self._do(unit, unit.life.start(now))
        if unit.life.deadline <= now:
            self._do(unit, unit.life.due(now))
        if unit.save_at <= now:
            unit.save_at = math.inf
            self._save(unit)

    def _has_been_up(self, name: str) -> bool:
        unit = self._units.get(name)
        return unit is not None and (unit.was_up or unit.elsewhere)

    def _needed(self, unit: Unit) -> bool:
        """Whether a child that must end first still runs."""
        others = (other for other in self._units.values() if unit.child.name in other.child.terms.after)
        return any(other.leaving and other.life.alive for other in others)

    def _set_children(self, children: Mapping[str, Child]) -> None:
        for name, unit in self._units.items():
            if name not in children:
                unit.leaving = "the file no longer names it"
        for name, child in children.items():
            unit = self._units.get(name)
            if unit is None:
                unit = self._units[name] = Unit(child, self._grace_s, self._clock)
                unit.lease = self._new_lease_end(child)
                continue
            same, was_leaving = unit.child.starts_like(child), bool(unit.leaving)
            if unit.child.lease != child.lease:
                unit.lease = self._new_lease_end(child)
            elif isinstance(unit.lease, Standby):
                unit.lease.set_children(child)
            unit.child, unit.life.terms, unit.leaving = child, child.terms, ""
            if unit.begun and (was_leaving or not same):
                self._do(unit, unit.life.start(self._clock()))

    def _new_lease_end(self, child: Child) -> LeaseEnd | None:
        lock = lock_of(self._folder, self._container().name, child.name)
        if child.terms.lease_from:
            return LeaseHolder(child, self._container, self._post, self._complain, lock)
        if child.terms.stands_in_for:
            return Standby(child, self._container, self._post, self._store, lock)
        return None

    def _restart(self, name: str, requester: str) -> None:
        unit = self._units.get(name)
        if unit is None or unit.leaving:
            return
        if unit.lease is not None and not unit.may_be_up():
            self._do(unit, unit.life.stop(self._clock(), unit.lease.why))  # also if given up: it asks for its lease
        else:
            self._report(unit, f"{name} is restarted at the request of {requester}")
            unit.begun = True
            self._do(unit, unit.life.start(self._clock()))

    def _stop(self, name: str, requester: str) -> None:
        unit = self._units.get(name)
        if unit is not None and not unit.leaving:
            self._report(unit, f"{name} is stopped at the request of {requester}")
            unit.begun = True
            self._do(unit, unit.life.stop(self._clock(), f"{requester} stops it"))

    def _close(self) -> None:
        self._closing = True
        for unit in self._units.values():
            unit.leaving = "the gateway leaves"

    # --- actions

    def _do(self, unit: Unit, do: Transition | None) -> None:
        match do:
            case Transition.LAUNCH:
                self._launch(unit)
            case Transition.ASK:
                self._ask(unit)
            case Transition.SAVE:
                self._save(unit)
            case Transition.LEAVE if unit.process is not None:
                if not unit.leaving:
                    self._report(unit, f"{unit.child.name} is asked to shut down: {unit.life.why}")
                unit.process.terminate()
            case Transition.KILL if unit.process is not None:
                self._report(unit, f"{unit.child.name} does not shut down and is killed", bad=True)
                unit.process.kill()
            case _:
                pass

    def _launch(self, unit: Unit) -> None:
        unit.boot, unit.furnished, unit.save_at = unit.boot + 1, None, math.inf
        try:
            unit.before = epochs_of(self._container(), unit.child)
            lock, unit.sent = (None, None) if unit.lease is None else (unit.lease.lock, unit.lease.term)
            unit.process = self._new_process(unit.child, self._folder / "logs", lock, unit.sent)
        except (OSError, ConfigurationError) as none:
            self._ended(unit, f"its process could not be started: {none}")
            return
        self._selector.register(unit.process.end, selectors.EVENT_READ, partial(self._died, unit))
        self._selector.register(unit.process.output, selectors.EVENT_READ, partial(self._read_output, unit))

    def _read_output(self, unit: Unit) -> None:
        process = unit.process
        if process is None:  # it ended in the same round
            return
        try:
            started, more = process.read()
        except ValueError:
            self._do(unit, unit.life.fail(self._clock(), "its first line did not report that it is up"))
            return
        if not more:
            self._selector.unregister(process.output)
        if started is not None:
            load = partial(self._store.load, unit.child.name) if unit.lease is None else unit.lease.load
            self._job(unit, "furnish", partial(self._furnish, unit, unit.child, started, load, unit.boot))

    def _died(self, unit: Unit) -> None:
        process, unit.process = unit.process, None
        if process is None:
            return
        self._selector.unregister(process.end)
        with contextlib.suppress(KeyError):  # its output ended before
            self._selector.unregister(process.output)
        how = process.close()
        self._ended(unit, how, absent=process.absent)

    def _ended(self, unit: Unit, how: str, *, absent: bool = False) -> None:
        life, name = unit.life, unit.child.name
        unit.boot, unit.furnished, unit.save_at = unit.boot + 1, None, math.inf
        before = life.why if life.absences else ""
        do = life.ended(self._clock(), how, absent=absent)
        match life.state:
            case State.WAITING if life.absences:
                if how != before:  # it is reported once, and not every 30 s
                    self._report(unit, f"{name} {how}; it waits for its device and is tried again", bad=True)
            case State.WAITING:
                self._report(unit, f"{name} {how}; back in {life.wait_s:g} s", bad=True)
            case State.GIVEN_UP:
                times = f"{life.terms.restarts + 1} times in {life.terms.window_s:g} s"
                again = f"trade call trade.restart_child '\"{name}\"' starts it again"
                self._report(unit, f"{name} ended {times} and is given up; the last time it {how}. {again}", bad=True)
            case State.STOPPED:
                self._report(unit, f"{name} {how}", bad=not unit.leaving)
            case _:
                pass
        self._do(unit, do)

    # --- health checks

    def _ask(self, unit: Unit) -> None:
        terms, furnished, now = unit.child.terms, unit.furnished, self._clock()
        if unit.process is None or furnished is None:
            return
        if terms.max_rss_mb is not None and (took := rss_mb(unit.process.pid)) > terms.max_rss_mb:
            self._do(unit, unit.life.fail(now, f"it took {took:.0f} MB of memory"))
            return
        if furnished.clock is None:
            self._job(unit, "health", partial(self._check_program, unit, unit.child))
            return
        try:
            run = _again(self._container(), furnished.clock).with_(deadline_s=terms.question_s).start()
        except TradeError:
            self._do(unit, unit.life.missed(now))
            return
        boot = unit.boot
        run.add_done_callback(lambda run: self._post(partial(self._answered, unit, boot, run)))

    def _answered(self, unit: Unit, boot: int, run: Run) -> None:
        if boot != unit.boot:
            return
        error, now = run.exception(0), self._clock()
        if isinstance(error, (TimeoutError, ConnectionError, ServiceGone)) and not isinstance(error, Busy):
            self._do(unit, unit.life.missed(now))
        else:
            unit.life.answered(now)

    def _check_program(self, unit: Unit, child: Child) -> Callable[[], None]:
        if health_problem(child):
            return lambda: self._do(unit, unit.life.missed(self._clock()))
        return lambda: unit.life.answered(self._clock())

    # --- slow work, on its own threads

    def _job(self, unit: Unit, what: str, work: Callable[[], Callable[[], None]]) -> None:
        """Runs blocking work on a thread; its result counts only for the current process."""
        boot = unit.boot

        def run() -> None:
            then = work()
            self._post(lambda: then() if unit.boot == boot else None)
            self._jobs.discard(threading.current_thread())

        thread = threading.Thread(target=run, name=f"trade-{what}-{unit.child.name}", daemon=True)
        self._jobs.add(thread)
        thread.start()

    def _furnish(
        self, unit: Unit, child: Child, started: Started, load: Callable[[], Any], boot: int
    ) -> Callable[[], None]:
        try:
            if child.part.entry.program is None:
                furnished = self._create_objects(self._container, child, started, load())
            else:
                furnished = await_program(self._container, child, unit.before, lambda: unit.boot != boot)
        except Exception as wrong:  # noqa: BLE001 - an object may raise its own types
            why = f"it came up, but: {wrong}"
            return lambda: self._do(unit, unit.life.fail(self._clock(), why))
        return lambda: self._up(unit, furnished)

    def _up(self, unit: Unit, furnished: CreatedObjects) -> None:
        unit.life.up(self._clock())
        if unit.life.state is not State.UP:
            return
        unit.furnished, unit.was_up = furnished, True
        unit.save_at = self._clock() + unit.child.terms.save_every_s if furnished.made else math.inf
        pid = unit.process.pid if unit.process else 0
        self._report(unit, f"{unit.child.name} is {'back' if unit.life.restarts else 'up'}, process {pid}")
        for problem in furnished.problems:
            self._report(unit, problem, bad=True)

    def _save(self, unit: Unit) -> None:
        furnished = unit.furnished
        if furnished is None or not furnished.made:
            self._saved(unit)
            return

        keep = partial(self._store.save, unit.child.name) if unit.lease is None else unit.lease.keep()

        def work() -> Callable[[], None]:
            began = time.time()
            states = save(self._container(), furnished)
            kept = bool(states) and keep(states)
            whole = kept and states.keys() == furnished.made.keys()
            return partial(self._saved, unit, began if whole else 0.0)

        self._job(unit, "save", work)

    def _saved(self, unit: Unit, saved_at: float = 0.0) -> None:
        now, unit.saved_at = self._clock(), saved_at or unit.saved_at
        if unit.life.state is State.STOPPING:
            self._do(unit, unit.life.saved(now))
        elif unit.furnished is not None and unit.furnished.made:
            unit.save_at = now + unit.child.terms.save_every_s

    def _complain(self, text: str) -> None:
        self._report_to(News(child="", state="", text=text, bad=True))

    def _report(self, unit: Unit, text: str, *, bad: bool = False) -> None:
        self._report_to(News(child=unit.child.name, state=unit.life.state.value, text=text, bad=bad))


def _again(container: Container, handle: Handle) -> Handle:
    """Returns the same service's handle of another container."""
    return container.handle(handle.key)
