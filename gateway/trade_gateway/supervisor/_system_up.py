"""Starts, inspects and ends the containers of a system file."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from msgspec import Struct

from trade import Container, ContainerInfo, Handle, where
from trade.errors import CannotStart, ConfigurationError, NoSuchService, TooManyServices, TradeError
from trade.starting import LONGEST_S, Started, end_there, launch, missing_there
from trade_gateway.config._entry import LOCAL, ContainerSpec
from trade_gateway.process._signals import SignalEvent
from trade_gateway.supervisor import ChildInfo
from trade_gateway.supervisor._objects import GROUP, lacking, make
from trade_gateway.supervisor._system_file import SystemPlan
from trade_gateway.terminal._detached import detached

_LEFT_S: Final = 20.0
"""How long a container may take to shut down, in seconds: a robot is brought to rest first."""
_LOOK_EVERY_S: Final = 0.05
_ASK_EVERY_S: Final = 0.2
_SHOWS: Final = "`trade call trade.child_tables` shows it"


class Report(Struct, frozen=True, kw_only=True):
    """The result for one container."""

    container: str
    host: str
    """The host as the file names it."""
    state: str
    """``started``, ``was up``, ``up``, ``down``, ``ended``, ``was down``, or what the container lacks."""
    pid: int = 0
    took_s: float = 0.0
    services: int = 0


Reporter = Callable[[Report], None]


class _StartedPart(NamedTuple):
    part: ContainerSpec
    started: Started


class SystemStarter:
    """The containers of one file, as a container of this command sees them.

    Args:
        plan: the checked file.
        container: this command's container in the system of the file.
        ssh_config: a configuration instead of the user's.
        wait_s: how long a started container may take to become visible, and an object to be created.
        report: called with the result of each container.
    """

    def __init__(
        self, plan: SystemPlan, container: Container, *, ssh_config: Path | None, wait_s: float, report: Reporter
    ) -> None:
        self._plan = plan
        self._container = container
        self._ssh_config = ssh_config
        self._wait_s = wait_s
        self._report = report

    def up(self, *, keep: bool, interrupted: threading.Event | SignalEvent) -> None:
        """Starts the containers that are not up, in order; a failure ends those that it started.

        Args:
            keep: after a failure, keep the containers that were started.
            interrupted: ends the start like a failure, once the current container is up and its process known.

        Raises:
            KeyboardInterrupt: the start was interrupted.
            CannotStart, ConfigurationError: with the reason; before any start if a host is unreachable.
            TradeError: an object could not be created.
        """
        absent = [part for part in self._plan.parts if not self._is_supervised(part) and self._visible(part) is None]
        check_hosts(self._plan, absent, self._ssh_config)
        started_parts: list[_StartedPart] = []
        try:
            for part in self._plan.parts:
                if self._is_supervised(part):
                    self._await_child(part, started_parts, interrupted)
                else:
                    self._start_part(part, started_parts)
                if interrupted.is_set():
                    raise KeyboardInterrupt
        except BaseException:
            if not keep:
                self._undo(started_parts)
            raise

    def _start_part(self, part: ContainerSpec, started_parts: list[_StartedPart]) -> None:
        at, info = time.monotonic(), self._visible(part)
        was_up = info is not None
        if info is None:
            started_parts.append(_StartedPart(part, self._start(part)))
            info = self._await(started_parts[-1])
        created = [
            make(self._own(part, "instantiate"), one, wait_s=self._wait_s) for one in lacking(self._container, part)
        ]
        state = "was up" if was_up and not created else "started"
        took_s = time.monotonic() - at
        self._report(Report(container=part.name, host=part.entry.host, state=state, pid=info.pid, took_s=took_s))

    def _is_supervised(self, part: ContainerSpec) -> bool:
        return part.name in self._plan.supervised

    def _supervisor(self, name: str) -> Handle:
        plan = self._plan
        return self._container.find(where(name=name, group=GROUP, container=plan.supervisor), wait_s=self._wait_s)

    def _child(self, part: ContainerSpec) -> ChildInfo | None:
        found: list[ChildInfo] = self._supervisor("children")()
        return next((child for child in found if child.name == part.name), None)

    def _await_child(
        self, part: ContainerSpec, started_parts: Sequence[_StartedPart], interrupted: threading.Event | SignalEvent
    ) -> None:
        """Waits until the supervisor has a container up, and reports each change of its state.

        Raises:
            CannotStart: the supervisor gave it up, or it was not up in time.
        """
        at, known, where_, pause = time.monotonic(), "", self._plan.at(part.name), threading.Event()
        is_new = any(one.part.name == self._plan.supervisor for one in started_parts)
        was_up = not is_new and (first := self._child(part)) is not None and first.state == "up"
        while not interrupted.is_set():
            child = self._child(part)
            state = "unknown" if child is None else f"{child.state}: {child.why}" if child.why else child.state
            if child is not None and child.state == "up":
                state, took_s = "was up" if was_up else "started", time.monotonic() - at
                self._report(Report(container=part.name, host=LOCAL, state=state, pid=child.pid, took_s=took_s))
                return
            late = time.monotonic() - at > self._wait_s
            if late and child is None:
                problem = f"{self._plan.supervisor} does not supervise it; which file does it read? {_SHOWS}"
                raise ConfigurationError(where=where_, problem=problem)
            if late or (child is not None and child.state == "given up"):
                why, output = ("it did not come up", child.why if child else "") if not late else ("timeout", state)
                remedy = f"its log is {part.name}.log in the folder logs of {self._plan.supervisor}"
                raise CannotStart(host=LOCAL, container=part.name, reason=why, output=output, remedy=remedy)
            if state not in (known, "stopped"):
                known = state
                self._report(Report(container=part.name, host=LOCAL, state=state))
            pause.wait(_ASK_EVERY_S)

    def _start(self, part: ContainerSpec) -> Started:
        entry = part.entry
        if entry.is_local:
            settings = replace(self._plan.settings, container=part.name)
            return detached(part.words, settings, {**os.environ, **part.environment})
        return launch(
            entry.host,
            part.name,
            part.words,
            command=(entry.command,),
            environment=part.environment,
            ssh_config=self._ssh_config,
        )

    def _await(self, started_parts: _StartedPart) -> ContainerInfo:
        part, started = started_parts
        with contextlib.suppress(NoSuchService, TooManyServices):  # the epoch identifies it
            self._container.find(where(name="clock", group=GROUP, container=part.name), wait_s=self._wait_s)
        info = next((one for one in self._container.containers() if one.epoch == started.epoch), None)
        if info is None:
            output = f"it is up there as process {started.pid}, but was not visible here within {self._wait_s:g} s"
            remedy = f"set its endpoints ({self._plan.at(part.name, 'connect')}), and give it the certificate"
            raise CannotStart(
                host=part.entry.host, container=part.name, reason="not seen", output=output, remedy=remedy
            )
        return info

    def _own(self, part: ContainerSpec, name: str) -> Handle:
        return self._container.find(where(name=name, group=GROUP, container=part.name), wait_s=self._wait_s)

    def _visible(self, part: ContainerSpec) -> ContainerInfo | None:
        """Returns the container of that name. Raises ConfigurationError if there are two."""
        return self._seen_name(part.name)

    def _seen_name(self, name: str) -> ContainerInfo | None:
        found = [info for info in self._container.containers() if info.name == name]
        if len(found) > 1:
            problem = f"there are {len(found)} of that name: {', '.join(f'{one.pid} on {one.host}' for one in found)}"
            raise ConfigurationError(where=self._plan.at(name), problem=problem)
        return found[0] if found else None

    def _undo(self, started_parts: Sequence[_StartedPart]) -> None:
        """Ends the containers that were started, in reverse order; one that cannot be ended is reported and kept."""
        for part, started in reversed(started_parts):
            try:
                if any(info.epoch == started.epoch for info in self._container.containers()):
                    self._end(part, only_at_rest=True)
                else:
                    self._end_unseen(part, started)
            except TradeError as left:
                self._report(
                    Report(container=part.name, host=part.entry.host, state=f"left up: {left}", pid=started.pid)
                )

    def _end_unseen(self, part: ContainerSpec, started: Started) -> None:
        if part.entry.is_local:
            with contextlib.suppress(ProcessLookupError):
                os.kill(started.pid, signal.SIGTERM)
        else:
            if not end_there(part.entry.host, part.name, started.pid, part.words, self._ssh_config):
                left = f"not ended: no process {started.pid} there runs `trade {' '.join(part.words)}`"
                self._report(Report(container=part.name, host=part.entry.host, state=left, pid=started.pid))
                return
        self._report(Report(container=part.name, host=part.entry.host, state="ended", pid=started.pid))

    def down(self, *, only_at_rest: bool) -> None:
        """Ends the containers in reverse order; stops at the first that cannot be ended.

        Raises:
            InUse: the container is locked or moves, and may end ``only_at_rest``.
            TradeError: the call to end it failed.
        """
        for part in reversed(self._plan.parts):
            if self._is_supervised(part):
                self._end_child(part, only_at_rest=only_at_rest)
            elif self._visible(part) is None:
                self._report(Report(container=part.name, host=part.entry.host, state="was down"))
            else:
                self._end(part, only_at_rest=only_at_rest)

    def _end_child(self, part: ContainerSpec, *, only_at_rest: bool) -> None:
        """Ends a supervised container, and keeps its supervisor from starting it again."""
        supervised = self._seen_name(self._plan.supervisor) is not None
        child = self._child(part) if supervised else None
        if child is None or not child.pid:
            self._report(Report(container=part.name, host=LOCAL, state="was down"))
            return
        at, pause = time.monotonic(), threading.Event()
        if part.entry.kind == "robot" and self._visible(part) is not None:
            self._own(part, "terminate_container").with_(deadline_s=_LEFT_S)("trade system down", only_at_rest)
        self._supervisor("stop_child")(part.name)
        while (child := self._child(part)) is not None and child.pid:
            if time.monotonic() - at > 2 * _LEFT_S:
                raise ConfigurationError(where=self._plan.at(part.name), problem="did not end; see `trade logs`")
            pause.wait(_LOOK_EVERY_S)
        took_s = time.monotonic() - at
        self._report(Report(container=part.name, host=LOCAL, state="ended", took_s=took_s))

    def _end(self, part: ContainerSpec, *, only_at_rest: bool) -> None:
        at, info = time.monotonic(), self._visible(part)
        terminate = self._own(part, "terminate_container").with_(deadline_s=_LEFT_S)
        problems = terminate("trade system down", only_at_rest)
        until, pause = at + _LEFT_S, threading.Event()
        while info is not None and any(one.epoch == info.epoch for one in self._container.containers()):
            if time.monotonic() > until:
                problem = f"did not end within {_LEFT_S:g} s; see `trade logs`"
                raise ConfigurationError(where=self._plan.at(part.name), problem=problem)
            pause.wait(_LOOK_EVERY_S)
        state = f"ended, but: {'; '.join(problems)}" if problems else "ended"
        took_s = time.monotonic() - at
        self._report(Report(container=part.name, host=part.entry.host, state=state, took_s=took_s))

    def status(self) -> Iterator[Report]:
        """Returns the state of each container of the file, in order."""
        for part in self._plan.parts:
            if self._is_supervised(part):
                yield self._child_status(part)
                continue
            info, host = self._visible(part), part.entry.host
            if info is None:
                yield Report(container=part.name, host=host, state="down")
                continue
            lacks = ", ".join(one.class_ for one in lacking(self._container, part))
            state = f"lacks {lacks}" if lacks else "up"
            yield Report(container=part.name, host=host, state=state, pid=info.pid, services=info.services)

    def _child_status(self, part: ContainerSpec) -> Report:
        child = self._child(part) if self._seen_name(self._plan.supervisor) is not None else None
        info = self._seen_name(part.entry.announces or part.name)
        services = 0 if info is None else info.services
        if child is None:
            return Report(container=part.name, host=LOCAL, state="down")
        state = f"{child.state}: {child.why}" if child.why else child.state
        return Report(container=part.name, host=LOCAL, state=state, pid=child.pid, services=services)


def check_hosts(plan: SystemPlan, parts: Sequence[ContainerSpec], ssh_config: Path | None) -> None:
    """Checks in parallel that all other hosts are reachable, and have ``trade`` and the named files.

    Raises:
        CannotStart: a host is unreachable, or has no ``trade``.
        ConfigurationError: a file is missing there; with its line.
    """
    asked = [part for part in parts if not part.entry.is_local]
    wrong: dict[str, TradeError] = {}

    def ask(part: ContainerSpec) -> None:
        try:
            missing = missing_there(part.entry.host, part.name, (part.entry.command,), part.files, ssh_config)
            if missing:
                problem = f"{part.entry.host} has no readable {', '.join(missing)}"
                raise ConfigurationError(where=plan.at(part.name, part.entry.kind), problem=problem)
        except TradeError as error:
            wrong[part.name] = error

    askers = [threading.Thread(target=ask, args=(part,), name=f"trade-ask-{part.name}") for part in asked]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join(LONGEST_S + 1)  # ssh has its own, shorter limit
    for part in asked:
        if part.name in wrong:
            raise wrong[part.name]
