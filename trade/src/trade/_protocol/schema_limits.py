"""Limits of an argument, and values beyond them, in words for people."""

import math
import re
from collections.abc import Iterator
from typing import Any, Final

from msgspec import Meta

# What is looked at came over the wire: it has no types.
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

__all__ = ["NOT_FINITE", "limits_text", "problem_text", "value_at"]

NOT_FINITE: Final = "must be finite: no NaN, no infinity"

_STEP: Final = re.compile(r"\[(\d+)\]|\.(\w+)")
_LONGEST_TEXT: Final = 60


def limits_text(notes: tuple[object, ...]) -> str:
    """What the notes of an ``Annotated`` type allow, such as ``0 to 1``; empty if they limit nothing."""
    metas = [note for note in notes if isinstance(note, Meta)]
    return ", ".join(part for meta in metas for part in _limits(meta))


def _limits(meta: Meta) -> Iterator[str]:
    if meta.ge is not None and meta.le is not None:
        yield f"{meta.ge:g} to {meta.le:g}"
    else:
        bounds = ((">=", meta.ge), ("<=", meta.le))
        yield from (f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)
    strict = ((">", meta.gt), ("<", meta.lt))
    yield from (f"{sign} {bound:g}" for sign, bound in strict if bound is not None)
    if meta.multiple_of is not None:
        yield f"a multiple of {meta.multiple_of:g}"
    lengths = (("at least", meta.min_length), ("at most", meta.max_length))
    yield from (f"{most} {length} long" for most, length in lengths if length is not None)
    if meta.pattern is not None:
        yield f"matching {meta.pattern!r}"


def value_at(given: Any, path: str) -> Any:
    """The part of an argument that msgspec points at with a path such as ``[1].x_m``.

    Raises:
        LookupError: the path does not lead to one value.
    """
    place = 0
    while place < len(path):
        step = _STEP.match(path, place)
        if step is None:
            raise LookupError(path)
        given = given[int(step[1])] if step[1] is not None else given[step[2]]
        place = step.end()
    return given


def problem_text(complaint: str, value: Any) -> str:
    """What is wrong with a value: what validation says of it, and the value where it says nothing of that."""
    if isinstance(value, float) and not math.isfinite(value):
        return NOT_FINITE
    if ", got " in complaint or not complaint.startswith("Expected "):
        return complaint
    shown = repr(value)
    return f"{complaint}, but is {shown if len(shown) <= _LONGEST_TEXT else shown[:_LONGEST_TEXT] + '...'}"
