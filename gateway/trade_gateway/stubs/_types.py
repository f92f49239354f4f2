"""Types as source text, with the imports and the classes that this text needs."""

import builtins
import collections.abc
import datetime as dt
import decimal
import keyword
import re
import types
import typing
import uuid
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, Literal, Union, get_args, get_origin

import msgspec

from trade.protocol.schema_types import type_from_schema

UNREADABLE: Final = (TypeError, ValueError, LookupError, AttributeError, RecursionError)
"""Errors of schemas that are none: they came from other containers."""
_GIVEN: Final[Mapping[Any, Any]] = {
    list: Sequence,
    tuple: Sequence,
    set: Collection,
    frozenset: Collection,
    dict: Mapping,
}
"""What an argument of a type may also be."""
_LITERALS: Final = (str, int, bool, type(None))
_SOURCES: Final = (builtins, collections.abc, dt, decimal, typing, uuid)
_RESERVED: Final = frozenset(["Handle", "annotations", *(name for module in _SOURCES for name in dir(module))])
"""Names that no class of the text gets."""


class TypeWriter:
    """Writes types as source text.

    A member of a class hides a name of the same spelling in the annotations of that class. Such a name is written with
    its module, as in ``_builtins.list``.
    """

    def __init__(self, hidden: Collection[str] = ()) -> None:
        """Starts with nothing written.

        Args:
            hidden: the names of all members of all classes.
        """
        self._hidden = hidden
        self.members: set[str] = set()
        """The names of members, for the next writer."""
        self.imports: dict[str, set[str]] = {}
        """Imported names, by module; an empty name is the module itself."""
        self.classes: dict[str, str] = {}
        """The source text of each class, by name."""

    def name(self, module: str, name: str) -> str:
        """Imports a name; returns what it is called in the text."""
        if name in self._hidden:
            self.imports.setdefault(module, set()).add("")
            return f"_{module.replace('.', '_')}.{name}"
        if module != "builtins":
            self.imports.setdefault(module, set()).add(name)
        return name

    def result(self, schema: Mapping[str, Any]) -> str:
        """The type that a caller gets for a schema, if it has imported no class of the provider."""
        return self._source(schema, given=False)

    def argument(self, schema: Mapping[str, Any]) -> str:
        """The type of what a caller may give for a schema."""
        return self._source(schema, given=True)

    def _source(self, schema: Mapping[str, Any], *, given: bool) -> str:
        try:
            return self._text(type_from_schema(schema, {}), given=given)
        except UNREADABLE:
            return self.name("typing", "Any")

    def add_class(self, title: str, lines: Sequence[str]) -> str:
        """Adds a class with these lines, unless it has an equal one; returns its name."""
        wanted = name = class_name(title)
        number = 1
        while True:
            text = f"class {name}({self.name('typing', 'Protocol')}):\n" + "\n".join(lines)
            free = name not in self.classes and name not in _RESERVED and name not in self._hidden
            if free or self.classes.get(name) == text:
                self.classes[name] = text
                return name
            number += 1
            name = f"{wanted}{number}"

    def _text(self, type_: Any, *, given: bool) -> str:
        if type_ is Any:
            return self.name("typing", "Any")
        if type_ is None or type_ is type(None):
            return "None"
        origin, inner = get_origin(type_), get_args(type_)
        if origin in (Union, types.UnionType):
            return " | ".join(dict.fromkeys(self._text(one, given=given) for one in inner))
        if origin is Literal:
            return self._literal(inner)
        if origin is not None:
            return self._generic(origin, inner, given=given)
        if issubclass(type_, msgspec.Struct):
            record = self._record(type_)
            return f"{record} | {self._text(dict[str, Any], given=True)}" if given else record
        return self.name(type_.__module__, type_.__name__)

    def _literal(self, values: Sequence[Any]) -> str:
        if not all(isinstance(value, _LITERALS) for value in values):
            return self.name("typing", "Any")
        return f"{self.name('typing', 'Literal')}[{', '.join(map(repr, values))}]"

    def _generic(self, origin: Any, inner: Sequence[Any], *, given: bool) -> str:
        texts = ["..." if one is Ellipsis else self._text(one, given=given) for one in inner]
        fixed = origin is tuple and Ellipsis not in inner
        if not given or fixed:
            return f"{self.name('builtins', origin.__name__)}[{', '.join(texts) or '()'}]"
        wide = _GIVEN[origin]
        return f"{self.name('collections.abc', wide.__name__)}[{', '.join(text for text in texts if text != '...')}]"

    def _record(self, type_: type[msgspec.Struct]) -> str:
        """A class with the attributes of a record."""
        lines: list[str] = []
        for field in msgspec.structs.fields(type_):
            if not is_member(field.name):
                continue
            self.members.add(field.name)
            lines.append(f"    @{self.name('builtins', 'property')}")
            lines.append(f"    def {field.name}(self) -> {self._text(field.type, given=False)}: ...")
        return self.add_class(type_.__name__, lines or ["    ..."])


def is_member(name: str) -> bool:
    """Whether a class can have a public member of that name."""
    return name.isidentifier() and name.isascii() and not keyword.iskeyword(name) and not name.startswith("_")


def class_name(title: str) -> str:
    """A name for a class: ``RosieHead`` for ``rosie.head``."""
    words = re.findall(r"[A-Za-z0-9]+", title)
    name = "".join(word[0].upper() + word[1:] for word in words)
    return name if name.isidentifier() and not keyword.iskeyword(name) else f"Class{name}"
