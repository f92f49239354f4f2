"""ROS messages as dicts, and as bytes of ROS 1 or of ROS 2 (CDR), by the definitions of their types.

A message is a dict of its fields: numbers, booleans, text, lists of them, messages in messages. ``uint8[]`` and
``byte[]`` are ``bytes``. A time or duration is ``{"sec": ..., "nanosec": ...}``, as in ROS 2, for both.
"""

import os
import re
import struct
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from trade.errors import ConfigurationError
from trade.text_files import read_text

Message = dict[str, Any]

_SHIPPED: Final = Path(__file__).parent / "definitions"
_FILLER: Final = "structure_needs_at_least_one_member"
"""Placeholder field of ROS 2 in a message without fields."""
_PARTS: Final = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
_TYPE: Final = re.compile(r"\w+/(msg|srv|action)/\w+", re.ASCII)
_TEXTS: Final = ("string", "wstring")
_MALFORMED: Final = (
    SerdeError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    TypeError,
    ValueError,
    struct.error,
)
"""Exceptions of reading and writing any malformed data."""
_OCTETS: Final = ("uint8", "byte", "octet", "char")


class Field(NamedTuple):
    """A field of a message."""

    name: str
    type: str
    """``float64``, ``string``, ``std_msgs/msg/Header``: the type of one element, for arrays too."""
    many: bool
    length: int
    """Length of a fixed array; 0: any."""


class Types:
    """The types of one side of the bridge: the standard ones, those shipped here, and those in further folders."""

    def __init__(self, ros: Literal[1, 2], folders: Iterable[Path] = (), installed: Iterable[Path] = ()) -> None:
        """Args:
            ros: the version whose encoding applies.
            folders: each with packages as ROS lays them out: ``PACKAGE/msg/NAME.msg``, ``srv``, ``action``.
            installed: the same, of which only types that are asked for are read.

        Raises:
            ConfigurationError: a definition cannot be read.
        """
        self.ros: Final = ros
        self._store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)
        self._wholes: dict[str, tuple[str, ...]] = {}
        self._installed = tuple(installed)
        for folder in (_SHIPPED / f"ros{ros}", *folders):
            self._read(folder)
        self._fields = cache(self._look_up)

    # --- lookup

    def fields(self, type_name: str) -> tuple[Field, ...]:
        """Returns the fields of a message type. Raises ConfigurationError: it is not known."""
        return self._fields(type_name)

    def parts(self, type_name: str) -> tuple[str, ...]:
        """Returns the message types of a service (request, response) or an action (goal, result, feedback).

        Raises:
            ConfigurationError: it is not known.
        """
        self._seek(type_name)
        found = self._wholes.get(type_name)
        if found is None:
            raise ConfigurationError(where="ROS type", problem=self._unknown(type_name, self._wholes))
        return found

    def definition(self, type_name: str) -> tuple[str, str]:
        """Returns the definition of a message type with all it contains, and its MD5 sum, both in the form of ROS 1."""
        self.fields(type_name)
        return self._store.generate_msgdef(type_name, ros_version=1)

    def hash(self, type_name: str) -> str:
        """Returns the type hash of ROS 2: ``RIHS01_...``."""
        self.fields(type_name)
        return self._store.hash_rihs01(type_name)

    # --- values

    def zero(self, type_name: str) -> Message:
        """Returns a message with zero in every field."""
        return self.message(self.object(type_name, {}))

    def to_bytes(self, type_name: str, message: Mapping[str, Any]) -> bytes:
        """Encodes a message; missing fields are zero.

        Raises:
            ConfigurationError: it has a field that is not in the type, or a value that does not fit.
        """
        made = self.object(type_name, message)
        write = self._store.serialize_ros1 if self.ros == 1 else self._store.serialize_cdr
        try:
            return bytes(write(made, type_name))
        except _MALFORMED as error:
            raise ConfigurationError(where=type_name, problem=f"does not fit: {error}") from None

    def from_bytes(self, type_name: str, data: bytes | memoryview) -> Message:
        """Decodes a message.

        Raises:
            ValueError: the bytes are not a message of this type.
        """
        self.fields(type_name)
        read = self._store.deserialize_ros1 if self.ros == 1 else self._store.deserialize_cdr
        try:
            return self.message(read(bytes(data), type_name))
        except _MALFORMED as error:
            raise ValueError(f"{len(data)} bytes are no {type_name}: {error}") from None

    def object(self, type_name: str, message: Mapping[str, Any]) -> Any:
        """Returns the library's object for a message."""
        fields = self.fields(type_name)
        if unknown := set(message) - {field.name for field in fields}:
            known = ", ".join(field.name for field in fields)
            raise ConfigurationError(where=type_name, problem=f"has no {', '.join(sorted(unknown))}; it has {known}")
        values = {field.name: self._put(type_name, field, message.get(field.name)) for field in fields}
        filled = {name: 0 for name, _ in self._store.fielddefs[type_name][1] if name == _FILLER}
        return self._store.types[type_name](**values, **filled)

    def message(self, made: Any) -> Message:
        """Returns the dict of such an object."""
        return {field.name: self._take(field, getattr(made, field.name)) for field in self.fields(made.__msgtype__)}

    # --- conversion

    def _put(self, of: str, field: Field, value: Any) -> Any:
        try:
            return self._put_many(field, value) if field.many else self._put_one(field.type, value)
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            raise ConfigurationError(where=f"{of}.{field.name}", problem=f"{value!r} does not fit: {error}") from None

    def _put_many(self, field: Field, value: Any) -> Any:
        given = [None] * field.length if value is None else value
        if field.length and len(given) != field.length:
            raise ValueError(f"it holds exactly {field.length}")
        if "/" in field.type or field.type in _TEXTS:
            return [self._put_one(field.type, one) for one in given]
        if isinstance(given, (bytes, bytearray)):
            return np.frombuffer(given, dtype=np.uint8)
        return np.array([self._put_one(field.type, one) for one in given], dtype=_dtype(field.type))

    def _put_one(self, type_: str, value: Any) -> Any:
        if "/" in type_:
            return self.object(type_, {} if value is None else value)
        if type_ in _TEXTS:
            return "" if value is None else _text(value)
        if type_ == "bool":
            return bool(value)
        if type_.startswith("float"):
            return 0.0 if value is None else float(value)
        return 0 if value is None else _whole(type_, value)

    def _take(self, field: Field, value: Any) -> Any:
        if not field.many:
            return self.message(value) if "/" in field.type else value
        if "/" in field.type:
            return [self.message(one) for one in value]
        if field.type in _OCTETS and isinstance(value, np.ndarray):
            return value.tobytes()
        return value.tolist() if isinstance(value, np.ndarray) else list(value)

    def _look_up(self, type_name: str) -> tuple[Field, ...]:
        self._seek(type_name)
        try:
            found = self._store.fielddefs[type_name][1]
        except KeyError:
            problem = self._unknown(type_name, self._store.fielddefs)
            raise ConfigurationError(where="ROS type", problem=problem) from None
        fields = tuple(_field(name, kind) for name, kind in found if name != _FILLER)
        for field in fields:
            if field.many and not field.length and self._is_nothing(field.type):
                problem = (
                    f"{field.name} is an array of {field.type}, which has no bytes, so its length cannot be checked"
                )
                raise ConfigurationError(where=type_name, problem=problem)
            if "/" in field.type:
                self.fields(field.type)
        return fields

    def _is_nothing(self, type_name: str) -> bool:
        """Whether a message takes no bytes, so that an array could claim any length; in ROS 2 none does."""
        if self.ros == 2 or type_name not in self._store.fielddefs:
            return False
        fields = [_field(name, kind) for name, kind in self._store.fielddefs[type_name][1] if name != _FILLER]
        return all((field.length or not field.many) and self._is_nothing(field.type) for field in fields)

    def _seek(self, type_name: str) -> None:
        """Reads the definition of a type from the installation of ROS, unless it is known."""
        if type_name in self._store.fielddefs or type_name in self._wholes or not _TYPE.fullmatch(type_name):
            return
        package, kind, name = type_name.split("/")
        for folder in self._installed:
            path = folder / package / kind / f"{name}.{kind}"
            if path.is_file():
                self._add(path, type_name, kind)
                return

    def _unknown(self, type_name: str, known: Iterable[str]) -> str:
        package, name = type_name.partition("/")[0], type_name.rpartition("/")[2]
        near = [one for one in known if one.rpartition("/")[2] == name]
        if near:
            return f"{type_name} is not known; there is {', '.join(near)}"
        here = any((folder / package).is_dir() for folder in self._installed)
        which = f"package {package} is installed, but without it" if here else f"package {package} is not installed"
        return f"{type_name} is not known: {which}. Put its definition in a folder of types"

    def _read(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ConfigurationError(where=str(folder), problem="there is no such folder of ROS definitions")
        for path in sorted(folder.glob("*/*/*.*")):
            kind, package = path.parent.name, path.parent.parent.name
            if path.suffix[1:] == kind and kind in ("msg", *_PARTS):
                self._add(path, f"{package}/{kind}/{path.stem}", kind)

    def _add(self, path: Path, type_name: str, type_: str) -> None:
        names = [f"{type_name}_{part}" for part in _PARTS.get(type_, ())]
        try:
            whole = read_text(path)
        except (OSError, UnicodeDecodeError) as bad:
            raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None
        texts = _sections(whole) if names else [whole]
        if names and len(texts) != len(names):
            raise ConfigurationError(where=str(path), problem=f"needs {len(names)} parts between ---, not {len(texts)}")
        try:
            for name, text in zip(names or [type_name], texts, strict=True):
                if name not in self._store.fielddefs:
                    # the library puts all types below msg; in ROS 2 the name is part of the hash
                    ((_, read),) = get_types_from_msg(
                        text or _nothing(self.ros), name.replace(f"/{type_}/", "/msg/")
                    ).items()
                    self._store.register({name: read})
        except TypesysError as error:
            raise ConfigurationError(where=str(path), problem=f"cannot be read: {error}") from None
        if names:
            self._wholes[type_name] = tuple(names)


def _nothing(ros: int) -> str:
    """The definition of a message without fields; in ROS 2 it takes one byte."""
    return f"uint8 {_FILLER}\n" if ros == 2 else "\n"


def _sections(text: str) -> list[str]:
    parts: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.strip() == "---":
            parts.append([])
        else:
            parts[-1].append(line)
    return ["\n".join(lines) + "\n" for lines in parts]


def _field(name: str, type_: Any) -> Field:
    match type_:
        case (Nodetype.BASE, (base, _)):
            return Field(name, base, many=False, length=0)
        case (Nodetype.NAME, other):
            return Field(name, other, many=False, length=0)
        case (Nodetype.ARRAY, (inner, length)):
            return Field(name, _field(name, inner).type, many=True, length=length)
        case (_, (inner, _)):
            return Field(name, _field(name, inner).type, many=True, length=0)
        case _:
            raise ConfigurationError(where=name, problem=f"has an unknown kind: {type_!r}")


def _dtype(type_: str) -> Any:
    return np.dtype("uint8" if type_ in _OCTETS else type_)


def _whole(type_: str, value: Any) -> int:
    if isinstance(value, float) and not value.is_integer():
        raise ValueError("it is not a whole number")
    number = int(value)
    limits = np.iinfo(_dtype(type_))
    if not limits.min <= number <= limits.max:
        raise ValueError(f"it must be from {limits.min} to {limits.max}")
    return number


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("it is not text")
    return value


def installed_definitions(ros: Literal[1, 2]) -> list[Path]:
    """The folders with the definitions of an installation of ROS, by its environment."""
    if ros == 2:
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        return [Path(prefix) / "share" for prefix in prefixes if prefix]
    paths = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
    return [*(Path(path) for path in paths if path), Path("/usr/share")]
