"""Messages that are almost right: real ones with bytes changed, and what is right outside and wrong inside."""

import json
from typing import Any, Final

import msgspec
from hypothesis import strategies as st

from tests.endurance.fuzz._target import Target

_BYTES: Final = ["00", "ff", "7f", "80", "90", "c0", "cb7ff8", "c328", "ffffffff", "00000080", "fffffd00", "fffffdfd"]
_TEXTS: Final = ["nan", "-1", "1e999", "[", "]", "{", "}", '"', "'", "=", "\n", ".", "*", "/", "..", "@"]
_LENGTHS: Final = ["ddffffffff", "dfffffffff", "c6ffffffff"]
_TOKENS: Final = [*map(bytes.fromhex, _BYTES + _LENGTHS), *map(str.encode, _TEXTS)]
_EDITS: Final = st.tuples(
    st.sampled_from(["set", "put in", "cut", "twice", "end"]),
    st.integers(0, 2**20),
    st.integers(1, 12),
    st.sampled_from(_TOKENS) | st.binary(min_size=1, max_size=8),
)


def changed(data: bytes, edits: list[tuple[str, int, int, bytes]]) -> bytes:
    """After these edits; places are counted round."""
    for kind, place, size, new in edits:
        at = place % (len(data) + 1)
        match kind:
            case "set":
                data = data[:at] + new + data[at + len(new) :]
            case "put in":
                data = data[:at] + new + data[at:]
            case "cut":
                data = data[:at] + data[at + size :]
            case "twice":
                data = data[: at + size] + data[at:]
            case _:
                data = data[:at]
    return data


def _scalars() -> st.SearchStrategy[Any]:
    return (
        st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=12)
        | st.sampled_from(["*", "a.b", "..", "/dev/zero", "1" * 90, "é", "tcp/0.0.0.0:1"])
    )  # fmt: skip


VALUES: Final = st.recursive(
    _scalars(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def inside(value: Any, way: list[int], new: Any) -> Any:
    """The same with something else at one place; a way says which of its parts, and which of that one's."""
    if not way or not isinstance(value, (list, dict)) or not value:
        return new
    turn, rest = way[0], way[1:]
    if isinstance(value, list):
        at = turn % len(value)
        return [*value[:at], inside(value[at], rest, new), *value[at + 1 :]]
    key = list(value)[turn % len(value)]
    return {**value, key: inside(value[key], rest, new)}


def toml(value: Any) -> str:
    """As TOML, tables within lines; what it has no word for is left out."""
    if not isinstance(value, dict):
        raise TypeError("a TOML file is a table")
    return "".join(f"{json.dumps(str(key))} = {_inline(one)}\n" for key, one in value.items() if one is not None)


def _inline(value: Any) -> str:
    match value:
        case dict():
            return (
                "{" + ", ".join(f"{json.dumps(str(k))} = {_inline(v)}" for k, v in value.items() if v is not None) + "}"
            )
        case list():
            return "[" + ", ".join(_inline(one) for one in value if one is not None) + "]"
        case bool():
            return str(value).lower()
        case float():
            return repr(value)
        case _:
            return json.dumps(value)


def almost(target: Target, written: list[bytes]) -> st.SearchStrategy[bytes]:
    """What is fed to a target: its corpus with changes, and a few bytes of nothing."""
    edited = st.builds(changed, st.sampled_from(written), st.lists(_EDITS, min_size=1, max_size=5))
    return edited | st.binary(max_size=64) if written else st.binary(max_size=64)


def wrong_inside(values: list[tuple[Any, Any]]) -> st.SearchStrategy[bytes]:
    """Values of a corpus with one part replaced, written as they were."""

    def written(which: tuple[Any, Any], way: list[int], new: Any) -> bytes:
        value, write = which
        try:
            return write(inside(value, way, new))
        except (TypeError, ValueError, OverflowError):  # this format has no word for it
            return b""

    return st.builds(written, st.sampled_from(values), st.lists(st.integers(0, 30), min_size=1, max_size=6), VALUES)


def understood(data: bytes) -> list[tuple[Any, Any]]:
    """What a message of the corpus means, if it is of a format with parts, and how that is written."""
    found: list[tuple[Any, Any]] = []
    for head in (b"", data[:1]):
        body = data[len(head) :]
        for read, write in ((msgspec.msgpack.decode, msgspec.msgpack.encode), (json.loads, _json), (_toml, _as_toml)):
            try:
                value = read(body)
            except Exception:  # noqa: BLE001 - another format
                continue
            if isinstance(value, (list, dict)) and value:
                found.append((value, lambda new, head=head, write=write: head + write(new)))
    return found


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()


def _toml(data: bytes) -> Any:
    return msgspec.toml.decode(data)


def _as_toml(value: Any) -> bytes:
    return toml(value).encode()
