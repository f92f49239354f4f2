"""What a sentence can ask for: a question has an answer, and an order has a plan, which runs once it is confirmed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from msgspec import Struct

from trade import Container, Lock
from trade_gateway.language._memory import Memory

PURPOSE: Final = "asked in a dialogue"
"""The reason that other clients see."""

_SHOWN: Final = 10
"""Further choices are only counted."""

Gaps = Mapping[str, str]
"""The contents of a sentence's gaps."""


class Unknown(Exception):
    """Nothing has that name; the text lists what exists."""


class Ambiguous(Exception):
    """A gap has several meanings."""

    def __init__(self, gap: str, choices: Sequence[str]) -> None:
        shown = [*choices[:_SHOWN], f"{len(choices) - _SHOWN} more"] if len(choices) > _SHOWN + 1 else choices
        super().__init__(f"which one do you mean: {', '.join(shown[:-1])} or {shown[-1]}?")
        self.gap = gap
        self.choices = tuple(choices)


@dataclass
class Requester:
    """Who asks: requests look and act as this container."""

    container: Container
    memory: Memory
    audit: Path | None = None
    """The folder of this host's audit records, if there is one."""
    keeps: bool = False
    """Whether a lock outlives the sentence that takes it."""
    locks: list[Lock] = field(default_factory=list[Lock])
    """The locks that it has taken."""


class Answer(Struct, frozen=True):
    """The result of a request."""

    count: int
    fields: Mapping[str, object]
    """The parts of the answer."""
    data: Any
    """The same for programs."""


class Plan(NamedTuple):
    """What an order will do: its names are resolved, and nothing was done yet."""

    shall: str
    """The order in full: ``move rosie.planner to container base``."""
    do: Callable[[], Answer]
    confirm: bool = True
    """Whether it moves or reconfigures something, so that it needs a yes."""
    stops: bool = False
    """Whether it is a stop, which nothing may delay."""


class Request(NamedTuple):
    """A question or an order that a phrase can stand for."""

    gaps: tuple[str, ...]
    """Its gaps."""
    fields: tuple[str, ...]
    """The parts of its answer."""
    ask: Callable[[Requester, Gaps], Answer | Plan]
    """Answers a question; plans an order, without doing anything."""
    is_order: bool = False
    """Whether it acts on the system."""


def order(gaps: tuple[str, ...], plan: Callable[[Requester, Gaps], Plan]) -> Request:
    """An order whose answer has a report."""
    return Request(gaps, ("count", "report"), plan, is_order=True)


def done(report: str, data: Any = None) -> Answer:
    """The answer of an order that did one thing."""
    return Answer(1, {"count": 1, "report": report}, data)
