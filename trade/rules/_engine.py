"""The rule engine: when an event occurs and a condition holds, run steps that configure the system."""

import itertools
import logging
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct, structs

from trade._calls.handle import Handle
from trade._container.container import Container
from trade._notifications.notification import Notification
from trade._services.decorator import service
from trade.protocol.messages import HEALTHY
from trade.rules._file import Rule, read_rules
from trade.rules._steps import TURNS, Firing, LoopDetector, RuleMark, StepResult, Way, done, fired, holds, turns

GROUP: Final = "rules"
MOST: Final = 5
"""A rule that fires this often within `WITHIN_S` for one service is in a loop."""
WITHIN_S: Final = 60.0
LOOK_S: Final = 1.0
"""How often to check whether a service is missing or present."""
_KEPT: Final = 200
_LONGEST_HEALTH: Final = 500

_logger = logging.getLogger("trade.rules")


class RuleInfo(Struct, frozen=True, kw_only=True):
    """The public description of one rule."""

    name: str
    occasion: str
    condition: str
    container: str
    """The container that runs it, with whose rights."""
    state: str
    """``standing``, or ``stopped`` until the file is read again."""
    why: str
    """Why it was stopped."""
    cooldown_s: float
    fired: int
    failed: int
    """How often a step failed, or the condition could not be checked."""
    skipped: int
    """Events during the cooldown."""
    last_error: str
    dry_run: bool


class _ActiveRule:
    """One active rule. Its events are handled one after the other."""

    def __init__(self, engine: "Rules", name: str, rule: Rule) -> None:
        self.name: Final = name
        self.target_text: Final = f"rule {name}"
        self.rule: Final = rule
        self._engine = engine
        self.why = ""
        self._notifications: list[Notification] = []
        self._resting: dict[str, int] = {}
        """Services, each with the end of its cooldown."""
        self._recent: deque[tuple[int, str]] = deque()
        """Its recent firings: time and service."""
        self._not_so_ns = time.monotonic_ns()
        """The last time that its condition did not hold."""
        self._way: Way = ()
        """The causes of its condition, while it holds."""
        self._fired = self._failed = self._skipped = 0
        self._last_error = ""

    def begin(self) -> None:
        container, when = self._engine.container, self.rule.when
        if when.every_s is not None:
            self._notifications.append(container.every(when.every_s, self._tick))
            return
        assert when.selection is not None  # noqa: S101 - checked with the file
        constraint = when.selection.constraint()
        match when.kind:
            case "joined":
                self._notifications.append(container.joined(constraint, self._happened))
            case "left":
                self._notifications.append(container.left(constraint, self._happened))
            case "changed":
                self._notifications.append(container.changed(constraint, self._altered))
            case "present":
                self._notifications.append(container.every(LOOK_S, self._look_at_each))
            case _:
                self._notifications.append(container.joined(constraint, self._there))
                self._notifications.append(container.every(LOOK_S, self._look))

    def end(self) -> None:
        for notification in self._notifications:
            notification.cancel()

    def info(self) -> RuleInfo:
        return RuleInfo(
            name=self.name,
            occasion=str(self.rule.when),
            condition="" if self.rule.if_ is None else f"if {self.rule.if_}",
            container=self._engine.container.name,
            state="stopped" if self.why else "standing",
            why=self.why,
            cooldown_s=self.rule.cooldown_s,
            fired=self._fired,
            failed=self._failed,
            skipped=self._skipped,
            last_error=self._last_error,
            dry_run=self._engine.dry_run,
        )

    # --- events

    def _happened(self, service: Handle) -> None:
        now = time.monotonic_ns()
        if now < self._resting.get(service.label, 0):
            self._skipped += 1
        elif self._holds(service)[0]:
            self._fire(service, self._way_to(service.label, now))

    def _altered(self, service: Handle) -> None:
        selection = self.rule.when.selection
        if selection is not None and selection.constraint().matches(service.record):  # and still matches
            self._happened(service)

    def _there(self, _about: Handle) -> None:
        self._not_so()

    def _look(self) -> None:
        selection = self.rule.when.selection
        if selection is not None and self._engine.container.services(selection.constraint()):
            self._not_so()
        else:
            self._tick()

    def _look_at_each(self) -> None:
        selection = self.rule.when.selection
        for about in self._engine.container.services(selection.constraint() if selection is not None else None):
            now = time.monotonic_ns()
            if not self.why and now >= self._resting.get(about.label, 0) and self._holds(about)[0]:
                self._fire(about, self._way_to(about.label, now))

    def _tick(self) -> None:
        if time.monotonic_ns() < self._resting.get("", 0):
            return
        held, about = self._holds(None)
        if not held:
            self._not_so()
            return
        if self.rule.when.every_s is None or self.rule.if_ is not None:  # the clock has no cause
            self._way = self._way or self._way_to("", self._not_so_ns)
        self._fire(about, self._way or (RuleMark(self.name),))

    def _not_so(self) -> None:
        self._not_so_ns, self._way = time.monotonic_ns(), ()

    def _holds(self, service: Handle | None) -> tuple[bool, Handle | None]:
        try:
            return holds(self._engine.container.client, self.rule.if_, service)
        except Exception as error:  # noqa: BLE001 - a condition that fails does not hold, and is reported
            self._fail(f"{type(error).__name__}: {error}")
            return False, service

    def _way_to(self, label: str, since_ns: int) -> Way:
        return self._engine.causes.way_to(RuleMark(self.name, label), since_ns)

    # --- firing

    def _fire(self, service: Handle | None, way: Way) -> None:
        loop = self._loop(way)
        if loop:
            self.end()
            self.why = loop
            self._engine.note(self._firing(service, way, stopped=loop))
            return
        firing, began = self._firing(service, way), time.monotonic_ns()
        self._recent.append((began, way[-1].service))
        past = self._engine.causes.begin(way)
        try:
            steps = done(self._engine.container.client, self.rule.do, service, dry_run=self._engine.dry_run)
        finally:
            past.ended_ns = time.monotonic_ns()
        self._fired += 1
        for error in (did.error for did in steps if did.error):
            self._fail(error)
        self._rest(way[-1].service, past.ended_ns)
        self._engine.note(structs.replace(firing, steps=steps, took_s=(past.ended_ns - began) / 1e9))

    def _firing(self, service: Handle | None, way: Way, *, stopped: str = "") -> Firing:
        return fired(self.name, str(self.rule.when), service, way, dry_run=self._engine.dry_run, stopped=stopped)

    def _loop(self, way: Way) -> str:
        """Why it must not fire again; empty if it may."""
        if turns(way) >= TURNS:
            last_turn = max(place for place, mark in enumerate(way[:-1]) if mark == way[-1])
            circle = " -> ".join(mark.rule for mark in way[last_turn:])
            return f"it triggers itself, {turns(way)} times over: {circle}"
        if self.rule.when.every_s is not None:
            return ""
        since_ns = time.monotonic_ns() - int(WITHIN_S * 1e9)
        while self._recent and self._recent[0][0] < since_ns:
            self._recent.popleft()
        often = sum(service == way[-1].service for _, service in self._recent)
        return f"it fired {often} times within {WITHIN_S:g} s; give it a longer cooldown_s" if often >= MOST else ""

    def _rest(self, label: str, now_ns: int) -> None:
        if self.rule.cooldown_s:
            self._resting = {known: until for known, until in self._resting.items() if until > now_ns}
            self._resting[label] = now_ns + int(self.rule.cooldown_s * 1e9)

    def _fail(self, error: str) -> None:
        self._failed += 1
        if error != self._last_error:  # the same error again is not news
            self._last_error = error
            _logger.warning("rule %s: %s", self.name, error)


class Rules:
    """Runs the rules of a file in a container, with its identity and rights. Ends with ``close()``.

    It is a provider in group ``rules``; its health names the rules that were stopped.
    """

    def __init__(
        self,
        container: Container,
        file: Path,
        *,
        audit: Path | None = None,
        dry_run: bool = False,
        callback: Callable[[Firing], object] = lambda _firing: None,
    ) -> None:
        """Start the rules.

        Args:
            container: the container that runs them.
            file: the rules file.
            audit: a file that gets a line of JSON for every firing, in addition to the logger ``trade.rules``.
            dry_run: report the calls of each event without making them.
            callback: called with every firing, on the thread that fired.

        Raises:
            ConfigurationError: the file is wrong; the error names the place.
            AccessDenied: the policy does not let this container offer services in group ``rules``.
        """
        self.container: Final = container
        self.dry_run: Final = dry_run
        self.causes: Final = LoopDetector()
        self._audit = audit
        self._tell = callback
        self._firings: deque[Firing] = deque(maxlen=_KEPT)
        self._numbers = itertools.count(1)
        self._active: dict[str, _ActiveRule] = {}
        self._closed = False
        rules = read_rules(file)
        container.register(self, GROUP)
        self._go_by(rules)
        container.note_change("rules read", str(file))

    def load(self, file: Path) -> None:
        """Replace the rules by those of a file. Unchanged rules continue undisturbed.

        Stopped rules start again.

        Raises:
            ConfigurationError: the file is wrong; the error names the place, and the old rules stay.
        """
        self._go_by(read_rules(file))
        self.container.note_change("rules read", str(file))

    def _go_by(self, rules: dict[str, Rule]) -> None:
        old = self._active
        kept = {name for name, one in old.items() if one.rule == rules.get(name) and not one.why}
        self._active = {name: old[name] if name in kept else _ActiveRule(self, name, rules[name]) for name in rules}
        for name in old.keys() - kept:
            old[name].end()
        for name in (name for name in rules if name not in kept):
            self.causes.forget(name)
            self._active[name].begin()
        self._show_health()

    @service(effect="read")
    def rules(self) -> list[RuleInfo]:
        """The active rules, with their state."""
        return [active.info() for _, active in sorted(self._active.items())]

    @service(effect="read")
    def rule_firings(self) -> list[Firing]:
        """The last firings, oldest first."""
        return list(self._firings)

    def note(self, firing: Firing) -> None:
        """Called by a rule that fired, or was stopped."""
        self._firings.append(firing)
        line = msgspec.json.encode(firing).decode()
        _logger.log(logging.ERROR if firing.stopped else logging.INFO, "%s", line)
        self.container.note_change("rule stopped" if firing.stopped else "rule fired", firing.rule)
        self.container.events.note(
            "rule_stopped" if firing.stopped else "rule_fired",
            firing.rule,
            firing.stopped or "; ".join(f"{did.step}: {did.error or did.result}" for did in firing.steps),
        )
        if self._audit is not None:
            try:
                with self._audit.open("a", encoding="utf-8") as file:
                    file.write(f"{line}\n")
            except OSError as full:
                _logger.warning("%s cannot be written: %s", self._audit, full)
        if firing.stopped and not self._closed:
            self._show_health()
        self._tell(firing)

    def _show_health(self) -> None:
        stopped = [f"rule {active.name}: {active.why}" for active in self._active.values() if active.why]
        health = f"stopped: {'; '.join(stopped)}"[:_LONGEST_HEALTH] if stopped else HEALTHY
        self.container.set_health(self, health)

    def close(self) -> None:
        """End all rules; running firings finish. Idempotent."""
        if not self._closed:
            self._closed = True
            for active in self._active.values():
                active.end()
            self.container.deregister(self)

    def __enter__(self) -> "Rules":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class DryRun(Struct, frozen=True, kw_only=True):
    """The result of a rehearsal of a rule."""

    rule: str
    occasion: str
    condition: str
    now: str
    """The current state of its condition."""
    fires: bool
    """Whether it would fire now."""
    steps: tuple[StepResult, ...]


def rehearse(container: Container, rules: dict[str, Rule]) -> list[DryRun]:
    """Rehearse rules in a container's current state. Checks conditions, and calls nothing else."""
    return [_rehearsed(container, name, rule) for name, rule in rules.items()]


def _rehearsed(container: Container, name: str, rule: Rule) -> DryRun:
    selection = rule.when.selection
    found: list[Handle] = container.services(selection.constraint()) if selection is not None else []
    about = found[0] if found and rule.when.of_services else None
    now = [f"{len(found)} match: {', '.join(handle.label for handle in found)}" if found else "nothing matches"]
    fires = bool(found) if rule.when.present is not None else not rule.when.of_services and not found
    if selection is None:
        now = []
    if rule.if_ is not None:
        try:
            held, about = holds(container.client, rule.if_, about)
            now.append("the condition holds" if held else "the condition does not hold")
        except Exception as error:  # noqa: BLE001 - part of the result
            held = False
            now.append(f"the condition cannot be asked: {type(error).__name__}: {error}")
        fires = fires and held
    unknown = about is None and (rule.when.of_services or rule.if_ is not None)
    steps = () if unknown else done(container.client, rule.do, about, dry_run=True)
    return DryRun(
        rule=name,
        occasion=str(rule.when),
        condition="" if rule.if_ is None else f"if {rule.if_}",
        now="; ".join(now),
        fires=fires,
        steps=steps,
    )
