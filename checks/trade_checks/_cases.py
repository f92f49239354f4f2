"""Checks and scenes that a command runs, chosen by their names."""

from collections.abc import Sequence
from typing import Protocol, TypeVar

from trade_gateway._usage import UsageError


class Case(Protocol):
    """A check or a scene, known by its name."""

    @property
    def name(self) -> str: ...


C = TypeVar("C", bound=Case)


def chosen(cases: Sequence[C], names: Sequence[str], what: str) -> list[C]:
    """Returns the cases that ``--only`` names, in the order of the table; by default all. Raises UsageError."""
    known = [case.name for case in cases]
    if unknown := [name for name in names if name not in known]:
        problem = f"there is no such {what}; there is {', '.join(known)}"
        raise UsageError(where=f"--only {unknown[0]}", problem=problem)
    return [case for case in cases if not names or case.name in names]
