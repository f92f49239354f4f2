"""Methods and functions that are declared elsewhere: ``lock = delegated(lambda parts: parts.lock_api, LockApi.lock)``.

The reference is made of sources that are read, not run. This gives each such name the signature and the docstring of
what it stands for.
"""

from typing import Any, Final

import griffe

_MAKERS: Final = {"delegated", "adelegated", "of_default", "aof_default", "in_thread"}


class Delegated(griffe.Extension):
    """Puts functions in the place of attributes that are made of functions."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Replace those of the package and of its container."""
        if "Container" in pkg.members:
            for scope in (pkg["Container"].final_target, pkg):
                _replace(pkg, scope)


def _replace(pkg: griffe.Module, scope: Any) -> None:
    for member in list(scope.members.values()):
        value = None if member.is_alias else _without_cast(getattr(member, "value", None))
        if isinstance(value, griffe.ExprCall) and value.function.canonical_name in _MAKERS:
            meant = pkg.modules_collection[_without_cast(value.arguments[-1]).canonical_path]
            scope.set_member(member.name, _as_function(member, meant, bound=scope.is_module))


def _without_cast(value: Any) -> Any:
    """What a `typing.cast` is about: its types are of type checkers only."""
    while isinstance(value, griffe.ExprCall) and value.function.canonical_name == "cast":
        value = value.arguments[-1]
    return value


def _as_function(member: Any, meant: Any, *, bound: bool) -> griffe.Function:
    parameters = list(meant.parameters)[1:] if bound else meant.parameters
    made = griffe.Function(
        member.name,
        lineno=member.lineno,
        endlineno=member.endlineno,
        parameters=griffe.Parameters(*parameters),
        returns=meant.returns,
        docstring=meant.docstring,
    )
    made.labels |= meant.labels
    return made
