"""The types of functions that find: type checkers cannot see them through a function that delegates."""

from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeVar, overload

from trade._calls.group_view import GroupView
from trade._calls.handle import Handle
from trade._calls.picking import Pick
from trade._registry.constraints import Constraint

_P = ParamSpec("_P")
_R = TypeVar("_R")
_Provider = TypeVar("_Provider")


class Find(Protocol):
    """The types of `CallClient.find`."""

    @overload
    def __call__(
        self,
        which: Constraint | str,
        *,
        group: str | None = None,
        container: str | None = None,
        wait_s: float = 2.0,
        pick: Pick | None = None,
    ) -> Handle: ...
    @overload
    def __call__(
        self,
        which: Callable[..., _Provider],  # a class; type[...] would leave out interfaces
        *,
        group: str | None = None,
        container: str | None = None,
        wait_s: float = 2.0,
        follow: bool = False,
    ) -> _Provider: ...


class FindRobot(Protocol):
    """The types of `CallClient.robot`."""

    @overload
    def __call__(self, group: str, *, wait_s: float = 2.0, follow: bool = False) -> GroupView: ...
    @overload
    def __call__(
        self, group: str, kind: Callable[..., _Provider], *, wait_s: float = 2.0, follow: bool = False
    ) -> _Provider: ...


class Afind(Protocol):
    """The types of `Container.afind`."""

    @overload
    async def __call__(
        self,
        which: Constraint | str,
        *,
        group: str | None = None,
        container: str | None = None,
        wait_s: float = 2.0,
        pick: Pick | None = None,
    ) -> Handle: ...
    @overload
    async def __call__(
        self,
        which: Callable[..., _Provider],
        *,
        group: str | None = None,
        container: str | None = None,
        wait_s: float = 2.0,
        follow: bool = False,
    ) -> _Provider: ...


class Acall(Protocol):
    """The types of `CallClient.acall`."""

    @overload
    async def __call__(
        self, which: Constraint | str, /, *args: Any, pick: Pick | None = None, **kwargs: Any
    ) -> Any: ...
    @overload
    async def __call__(self, which: Callable[_P, _R], /, *args: _P.args, **kwargs: _P.kwargs) -> _R: ...
