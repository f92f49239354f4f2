"""Faults and orders as arguments of a command line: ``jam ids=4 bus=wrist``. Pure."""

import inspect
from collections.abc import Sequence
from typing import Final

import msgspec

from trade_hil_sim.control._server import State
from trade_hil_sim.faults._commands import Command, SimulationError, kinds_of

_KINDS: Final = {**kinds_of(Command), "state": State}


def command_of(words: Sequence[str]) -> Command | State:
    """The command that these arguments name, a fault and its ``KEY=VALUE``.

    Raises:
        SimulationError: they name none; says what would be valid.
    """
    name, *pairs = words
    kind = _KINDS.get(name)
    if kind is None:
        raise SimulationError(f"there is no fault {name!r}; there is {', '.join(_KINDS)}")
    keys = ", ".join(kind.__struct_fields__)
    try:
        values = {key: _value(key, text) for key, text in map(_pair, pairs)}
        return msgspec.convert({"do": name, **values}, kind, strict=False)  # pyright: ignore[reportReturnType]
    except (msgspec.ValidationError, ValueError) as problem:
        raise SimulationError(f"{name}: {problem}; " + (f"its keys are {keys}" if keys else "it has no keys")) from None


def listing() -> str:
    """A line for each fault: its keys but ``bus``, and what it does."""
    return "".join(f"  {name:<15} {_described(kind)}\n" for name, kind in sorted(_KINDS.items()))


def _described(type_: type[msgspec.Struct]) -> str:
    keys = " ".join(key for key in type_.__struct_fields__ if key != "bus")
    summary = (inspect.getdoc(type_) or "").splitlines()[0].replace("`", "")
    return f"{summary} [{keys}]" if keys else summary


def _pair(word: str) -> tuple[str, str]:
    key, equals, text = word.partition("=")
    if not equals:
        raise SimulationError(f"{word!r} is no KEY=VALUE, such as ids=1,2 or on=false")
    return key, text


def _value(key: str, text: str) -> object:
    return [_number(one) for one in text.split(",")] if key == "ids" else _number(text)


def _number(text: str) -> object:
    """A number in hex; other text is left for the kind to convert."""
    return int(text, 16) if text.startswith("0x") else text
