"""Patterns of keys: ``*`` stands for one chunk, ``**`` for any number of them, none included."""

import functools
from typing import Final

_ONE: Final = "*"
_ANY: Final = "**"


@functools.lru_cache(maxsize=4096)
def meet(one: str, other: str) -> bool:
    """Whether some key matches both arguments; each is a pattern or a plain key.

    As in zenoh, a chunk that begins with ``@`` matches only itself.
    """
    return _meet(one.split("/"), other.split("/"))


def _meet(one: list[str], other: list[str]) -> bool:
    if not one or not other:
        return all(chunk == _ANY for chunk in one + other)
    if one[0] == _ANY:
        return _meet(one[1:], other) or (_is_open(other[0]) and _meet(one, other[1:]))
    if other[0] == _ANY:
        return _meet(other, one)
    alike = one[0] == other[0] or (_ONE in (one[0], other[0]) and _is_open(one[0]) and _is_open(other[0]))
    return alike and _meet(one[1:], other[1:])


def _is_open(chunk: str) -> bool:
    return not chunk.startswith("@")
