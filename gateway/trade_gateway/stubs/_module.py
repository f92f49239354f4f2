"""A module of typed classes for a group: one class for each group, with handles and groups as attributes."""

import inspect
import keyword
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from trade import Handle
from trade_gateway.stubs._types import UNREADABLE, TypeWriter, is_member

_HANDLE: Final = '''_P = {ParamSpec}("_P")
_R = {TypeVar}("_R")


def _handle(service: {Callable}[{Concatenate}[{Any}, _P], _R]) -> {Handle}[_P, _R]:
    """Types a method as the handle of its service."""
    return {cast}("{Handle}[_P, _R]", service)
'''
_HANDLE_NAMES: Final = {
    "typing": ("Any", "Concatenate", "ParamSpec", "Protocol", "TypeVar", "cast"),
    "collections.abc": ("Callable",),
    "trade": ("Handle",),
}


def write_stubs(handles: Sequence[Handle], group: str, system: str) -> str:
    """Writes the module: the same text for the same services.

    Args:
        handles: the services of the group and of the groups beneath it.
        group: the dotted group.
        system: the system that they are in.

    Returns:
        The source text of a module, which is also valid as a ``.pyi`` file.
    """
    tree = _tree(handles, group)
    first = TypeWriter()
    _write_group(tree, first)
    writer = TypeWriter(first.members)
    root = _write_group(tree, writer)
    named = {name: writer.name(module, name) for module, names in _HANDLE_NAMES.items() for name in names}
    head = [
        f"# Types of the group {group} in the system {system}, as its services described themselves.",
        f"# Written by: trade --system {system} stubs {group}",
        f"# Use: robot = trade.robot({group!r}, {root})",
        "from __future__ import annotations",
    ]
    parts = ["\n".join(head), "\n".join(_imports(writer)), _HANDLE.format(**named).rstrip()]
    return "\n\n".join(parts) + "\n\n\n" + "\n\n\n".join(writer.classes.values()) + "\n"


def _imports(writer: TypeWriter) -> list[str]:
    lines: list[str] = []
    for module, names in sorted(writer.imports.items()):
        if "" in names:
            lines.append(f"import {module} as _{module.replace('.', '_')}")
        if given := sorted(names - {""}):
            lines.append(f"from {module} import {', '.join(given)}")
    return lines


@dataclass
class _Group:
    """A group: its services, by name, and the groups beneath it."""

    path: str
    services: dict[str, list[Handle]] = field(default_factory=dict[str, list[Handle]])
    groups: dict[str, "_Group"] = field(default_factory=dict[str, "_Group"])


def _tree(handles: Sequence[Handle], root: str) -> _Group:
    tree = _Group(root)
    for handle in handles:
        for path in handle.groups:
            if f"{path}.".startswith(f"{root}."):
                node = tree
                for name in path.removeprefix(root).split(".")[1:]:
                    node = node.groups.setdefault(name, _Group(f"{node.path}.{name}"))
                node.services.setdefault(handle.name, []).append(handle)
    return tree


def _write_group(group: _Group, writer: TypeWriter) -> str:
    """Writes the class of a group, after those of the groups beneath it; returns its name."""
    lines = [f'    """The group {group.path}."""']
    indexed: dict[str, str] = {}
    names = sorted({*group.services, *group.groups})
    for name in names:
        found = group.services.get(name, [])
        attribute = _attribute(name, names)
        beneath = _write_group(group.groups[name], writer) if name in group.groups else ""
        if len(found) + bool(beneath) > 1:
            lines += ["", f"    # {name!r} is no attribute: {_ambiguous(found, beneath)}"]
        elif attribute is None:
            indexed[name] = beneath or writer.name("trade", "Handle")
        else:
            writer.members.add(attribute)
            member = _group_member(attribute, beneath, writer) if beneath else _service(attribute, found[0], writer)
            lines += ["", *member]
    return writer.add_class(group.path, [*lines, "", *_index(indexed, writer)])


def _ambiguous(found: Sequence[Handle], beneath: str) -> str:
    if beneath:
        return "it is a service and a group; use trade.find or trade.robot"
    return f"{len(found)} services have this name; select one with trade.find and its container"


def _attribute(name: str, names: Sequence[str]) -> str | None:
    """The attribute of a group for a name; None if there is only the index."""
    wanted = f"{name}_" if keyword.iskeyword(name) else name
    taken = wanted != name and wanted in names
    return None if taken or not is_member(wanted) else wanted


def _group_member(attribute: str, kind: str, writer: TypeWriter) -> list[str]:
    return [f"    @{writer.name('builtins', 'property')}", f"    def {attribute}(self) -> {kind}: ..."]


def _service(attribute: str, handle: Handle, writer: TypeWriter) -> list[str]:
    return [
        "    @_handle",
        f"    def {attribute}{_signature(handle, writer)}:",
        *(f"        {line}".rstrip() for line in _docstring(handle.__doc__ or "")),
        "        ...",
    ]


class _Text:
    """A text that `inspect.Signature` shows as it is."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _signature(handle: Handle, writer: TypeWriter) -> str:
    """The parameters and the result of a method; parameters that Python cannot express are of any kind."""
    returns = _Text(writer.result(handle.schema["result"]))
    own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    try:
        parameters = [
            _typed(one, handle.schema["arguments"], writer) for one in inspect.signature(handle).parameters.values()
        ]
        if not any(one.kind is one.POSITIONAL_ONLY for one in parameters):
            own = own.replace(kind=own.POSITIONAL_OR_KEYWORD)
        return str(inspect.Signature([own, *parameters], return_annotation=returns))
    except UNREADABLE:
        anything = writer.name("typing", "Any")
        return f"(self, *args: {anything}, **kwargs: {anything}) -> {returns!r}"


def _typed(parameter: inspect.Parameter, schema: Mapping[str, Any], writer: TypeWriter) -> inspect.Parameter:
    if not is_member(parameter.name):
        raise ValueError(parameter.name)
    own = schema.get("properties", {}).get(parameter.name, {})
    kind = writer.argument({**own, "$defs": schema.get("$defs", {})})
    default = parameter.empty if parameter.default is parameter.empty else _Text("...")
    return parameter.replace(annotation=_Text(kind), default=default)


def _docstring(text: str) -> list[str]:
    """A docstring; a text that a docstring cannot show as it is becomes one line with escapes."""
    plain = all(one.isprintable() or one == "\n" for one in text)
    if not plain or "\\" in text or '"""' in text or text.endswith('"'):
        return [repr(text)]
    return [*f'"""{text}'.split("\n"), '"""'] if "\n" in text else [f'"""{text}"""']


def _index(indexed: Mapping[str, str], writer: TypeWriter) -> list[str]:
    """The index of a group: typed for the names that are no attributes."""
    text, anything = writer.name("builtins", "str"), writer.name("typing", "Any")
    general = f"    def __getitem__(self, path: {text}, /) -> {anything}: ..."
    if not indexed:
        return [general]
    overload = f"    @{writer.name('typing', 'overload')}"
    literal = writer.name("typing", "Literal")
    lines = [
        line
        for name, kind in indexed.items()
        for line in (overload, f"    def __getitem__(self, path: {literal}[{name!r}], /) -> {kind}: ...")
    ]
    return [*lines, overload, general]
