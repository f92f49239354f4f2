"""A rules file: events and the calls to make. The whole file is checked before any of it applies."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, cast

import msgspec
from msgspec import UNSET, Struct, UnsetType

from trade._calls.handle import LONGEST_DEADLINE_S, Handle
from trade._calls.picking import Pick
from trade._notifications.triggers import LONGEST_S, SHORTEST_S
from trade._registry.constraints import Constraint, where
from trade.errors import ConfigurationError
from trade.protocol.keys import is_chunk
from trade.protocol.messages import Scalar
from trade.text_files import read_text
from trade.toml_files import mismatch, read_toml_text

SERVICE: Final = "$service"
"""The service that joined, left or changed; for an event without one, the service that ``if`` calls."""
CONTAINER: Final = "$container"
"""The name of that service's container."""

_EXAMPLES: Final = {
    "when": 'when = { left = { name = "look", group = "rosie" } }',
    "do": 'do = [{ call = { name = "set_broadcast", group = "trade", local = true }, args = [true] }]',
    "service": 'service = { name = "level", group = "rosie.battery" }',
}


class Selection(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A selection of services: the words of `where` that are plain data; all of them must hold."""

    name: str | None = None
    group: str | None = None
    host: str | None = None
    container: str | None = None
    local: bool | None = None
    needs: str | list[str] | None = None
    achieves: str | list[str] | None = None
    uses: str | None = None
    kind: str | None = None
    meta: dict[str, Scalar] | None = None
    healthy: bool | None = None

    def constraint(self, service: Handle | None = None) -> Constraint:
        """The selection as a constraint; ``service``: that of the event."""
        container = service.container if service is not None and self.container == CONTAINER else self.container
        return where(
            name=self.name,
            group=self.group,
            host=self.host,
            container=container,
            local=self.local,
            needs=self.needs,
            achieves=self.achieves,
            uses=self.uses,
            kind=self.kind,
            meta=self.meta,
            healthy=self.healthy,
        )


class RuleEvent(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The event of a rule: exactly one of these."""

    joined: Selection | None = None
    left: Selection | None = None
    changed: Selection | None = None
    """A service matches after a change of its groups, metadata, health or description."""
    missing: Selection | None = None
    """While no service matches."""
    present: Selection | None = None
    """While a service matches; for each one."""
    every_s: float | None = None

    @property
    def kind(self) -> str:
        """The kind of the event."""
        return next(name for name in self.__struct_fields__ if getattr(self, name) is not None)

    @property
    def selection(self) -> Selection | None:
        """The services that the event is about."""
        return self.joined or self.left or self.changed or self.missing or self.present

    @property
    def of_services(self) -> bool:
        """Whether ``$service`` exists."""
        return self.missing is None and self.every_s is None

    def __str__(self) -> str:
        if self.every_s is not None:
            return f"every {self.every_s:g} s"
        return f"{self.kind} {cast('Selection', self.selection).constraint()}"


class Condition(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"is_": "is"}):
    """A service that only reads, and the result it must have: True by default."""

    service: Selection
    args: list[Any] | dict[str, Any] = []
    field: str = ""
    """A field of its result."""
    above: float | None = None
    below: float | None = None
    is_: Scalar | UnsetType = UNSET

    def holds(self, answer: Any) -> bool:
        """Whether a result meets the condition.

        Raises:
            ConfigurationError: the result cannot be compared.
        """
        value = _picked(answer, self.field)
        if self.is_ is not UNSET:
            return value == self.is_ and isinstance(value, bool) is isinstance(self.is_, bool)
        if self.above is None and self.below is None:
            if not isinstance(value, bool):
                raise ConfigurationError(where=str(self), problem=f"needs above, below or is: it answers {value!r}")
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigurationError(where=str(self), problem=f"answers {value!r}, which is no number")
        return (self.above is None or value > self.above) and (self.below is None or value < self.below)

    def __str__(self) -> str:
        conditions = [f"above {self.above:g}" if self.above is not None else ""]
        conditions += [f"below {self.below:g}" if self.below is not None else ""]
        conditions += [f"is {self.is_!r}" if self.is_ is not UNSET else ""]
        field = f", {self.field}" if self.field else ""
        return " ".join(["the service with", f"{self.service.constraint()}{field}", *filter(None, conditions)])


def _picked(answer: Any, field: str) -> Any:
    if not field:
        return answer
    fields: Any = answer
    value = fields.get(field, UNSET) if isinstance(answer, Mapping) else getattr(fields, field, UNSET)
    if value is UNSET:
        raise ConfigurationError(where=f"field {field!r}", problem=f"the answer has none: {answer!r}")
    return value


class Step(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A call of the only service that matches, or a wait until one matches."""

    call: Selection | str | None = None
    """``$service``: the service of the event."""
    args: list[Any] | dict[str, Any] = []
    """In order, or by name."""
    deadline_s: float = 10.0
    pick: Pick | None = None
    """Which one to call if several match."""
    wait_for: Selection | None = None
    s: float = 10.0
    """How long to wait."""
    always: bool = False
    """Run it even after a failed step."""

    def __str__(self) -> str:
        if isinstance(self.wait_for, Selection):
            return f"wait {self.s:g} s for {self.wait_for.constraint()}"
        return f"call {self.call.constraint() if isinstance(self.call, Selection) else self.call}"


class Rule(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"if_": "if"}):
    """One rule."""

    when: RuleEvent
    do: list[Step]
    if_: Condition | None = None
    cooldown_s: float = 0.0
    """After it has fired, events of the same service are ignored for this time."""


class RulesFile(Struct, frozen=True, forbid_unknown_fields=True):
    """A whole rules file."""

    rule: dict[str, Any]


def read_rules(path: Path, text: str | None = None) -> dict[str, Rule]:
    """Read and check a rules file; the rules by name.

    Args:
        path: the file.
        text: contents to check in its place, before they are written.

    Raises:
        ConfigurationError: names the file, the key and the right form.
    """
    file = str(path)
    try:
        raw = read_toml_text(read_text(path) if text is None else text)
    except OSError as bad:
        raise ConfigurationError(where=file, problem=f"cannot be read: {bad.strerror or bad}") from None
    except ValueError as bad:  # not TOML, or not UTF-8
        raise ConfigurationError(where=file, problem=f"not valid TOML: {bad}") from None
    tables = _converted(raw, RulesFile, file, "").rule
    rules: dict[str, Rule] = {}
    for name, table in tables.items():
        at = f"{file}: rule.{name}"
        if not is_chunk(name):
            raise ConfigurationError(where=at, problem="is no name; use letters, digits, . _ - (at most 80)")
        rules[name] = _converted(table, Rule, at, ".")
        _Check(rules[name], at).all()
    return rules


def _converted(raw: Any, type_: Any, where: str, joint: str) -> Any:
    try:
        return msgspec.convert(raw, type_)
    except msgspec.ValidationError as bad:
        found = mismatch(bad)
    place = f"{where}{joint or ': '}{found.place}" if found.place else where
    if key := found.missing:
        raise ConfigurationError(where=place, problem=f"{key} is missing; write {_EXAMPLES.get(key, key)}")
    if found.unknown:
        raise ConfigurationError(where=place, problem=f"has no {found.unknown!r}; {_known(found.place, type_)}")
    raise ConfigurationError(where=place, problem=found.problem)


def _known(path: str, type_: Any) -> str:
    """The valid keys at a place."""
    last = re.sub(r"\[.*?\]", "", path).rpartition(".")[2]
    kinds: dict[str, Any] = {"": type_, "when": RuleEvent, "if": Condition, "do": Step}
    return f"there is {', '.join(kinds.get(last, Selection).__struct_encode_fields__)}"


class _Check:
    """Checks that the types cannot express."""

    def __init__(self, rule: Rule, at: str) -> None:
        self._rule = rule
        self._location = at

    def all(self) -> None:
        rule = self._rule
        given = [name for name in rule.when.__struct_fields__ if getattr(rule.when, name) is not None]
        if len(given) != 1:
            self._wrong("when", f"says {' and '.join(given) or 'nothing'}; it is exactly one: {_EXAMPLES['when']}")
        if rule.when.selection is not None:
            self._selection(rule.when.selection, f"when.{given[0]}", known=None)
        self._number("when.every_s", rule.when.every_s, SHORTEST_S, LONGEST_S)
        self._number("cooldown_s", rule.cooldown_s, 0.0, LONGEST_S)
        if (rule.when.missing or rule.when.present) is not None and rule.cooldown_s <= 0:
            self._wrong("cooldown_s", "missing; say how long to wait before the next try: cooldown_s = 60")
        if rule.if_ is not None:
            self._condition(rule.if_)
        if not rule.do:
            self._wrong("do", f"has no steps; write {_EXAMPLES['do']}")
        for number, step in enumerate(rule.do):
            self._step(step, f"do[{number}]")

    def _condition(self, condition: Condition) -> None:
        self._selection(condition.service, "if.service", known=self._rule.when.of_services)
        self._filled(condition.args, "if.args", known=self._rule.when.of_services)
        self._number("if.above", condition.above, -math.inf, math.inf)
        self._number("if.below", condition.below, -math.inf, math.inf)
        if condition.is_ is not UNSET and (condition.above is not None or condition.below is not None):
            self._wrong("if", "is cannot be combined with above or below")

    def _step(self, step: Step, at: str) -> None:
        if (step.call is None) is (step.wait_for is None):
            self._wrong(at, "is one of call and wait_for")
        if step.wait_for is not None:
            self._selection(step.wait_for, f"{at}.wait_for")
            if step.pick is not None:
                self._wrong(f"{at}.pick", "is of call; a wait ends with the first service that matches")
        elif isinstance(step.call, Selection):
            self._selection(step.call, f"{at}.call")
        elif step.call == SERVICE:
            self._filled(step.call, f"{at}.call")
        else:
            problem = f'{step.call!r} is no service; write call = {{ name = "...", group = "..." }}, or "{SERVICE}"'
            self._wrong(f"{at}.call", problem)
        self._filled(step.args, f"{at}.args")
        self._number(f"{at}.deadline_s", step.deadline_s, SHORTEST_S, LONGEST_DEADLINE_S)
        self._number(f"{at}.s", step.s, 0.0, LONGEST_DEADLINE_S)

    def _selection(self, selection: Selection, at: str, *, known: bool | None = True) -> None:
        if selection == Selection():
            self._wrong(at, f"says nothing; there is {', '.join(Selection.__struct_fields__)}")
        if selection.container == CONTAINER:
            if known is None:
                self._wrong(at, f"{CONTAINER} is known only once it has happened")
            self._filled(CONTAINER, at, known=bool(known))
        try:
            selection.constraint()
        except ConfigurationError as bad:
            self._wrong(at, bad.problem)

    def _filled(self, value: Any, at: str, *, known: bool = True) -> None:
        """Checks the placeholders in a value; ``known``: including a condition's."""
        about = self._rule.when.of_services or (known and self._rule.if_ is not None)
        for text in _texts(value):
            if text.startswith("$") and text not in (SERVICE, CONTAINER):
                self._wrong(at, f"{text!r} is no placeholder; there is {SERVICE} and {CONTAINER}")
            if text in (SERVICE, CONTAINER) and not about:
                known_in = "joined, left, changed, present or if"
                problem = f"{text} is of rules with {known_in}; this one has {self._rule.when.kind}"
                self._wrong(at, problem)

    def _number(self, key: str, value: float | None, least: float, most: float) -> None:
        if value is not None and not (math.isfinite(value) and least <= value <= most):
            self._wrong(key, f"must be a number from {least:g} to {most:g}, not {value}")

    def _wrong(self, key: str, problem: str) -> None:
        raise ConfigurationError(where=f"{self._location}.{key}", problem=problem)


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        value = list(cast("Mapping[str, Any]", value).values())
    return [text for one in cast("list[Any]", value) for text in _texts(one)] if isinstance(value, list) else []


def filled(value: Any, service: Handle | None) -> Any:
    """A value of the file with ``$service`` and ``$container`` replaced."""
    if isinstance(value, Mapping):
        return {key: filled(one, service) for key, one in cast("Mapping[str, Any]", value).items()}
    if isinstance(value, list):
        return [filled(one, service) for one in cast("list[Any]", value)]
    if service is not None and isinstance(value, str):
        return {SERVICE: service, CONTAINER: service.container}.get(value, value)
    return value
