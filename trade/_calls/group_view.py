"""Groups as objects: what is beneath a group are its attributes."""

import difflib
import keyword
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NoReturn

from trade._calls.handle import Handle
from trade._registry.constraints import Constraint
from trade._registry.registry import Record
from trade._registry.suggestions import too_many_services
from trade.errors import ConfigurationError, NoSuchService
from trade.protocol.keys import ServiceKey

_MOST_SHOWN = 12


class NoSuchMember(NoSuchService, AttributeError):
    """A group has neither a service nor a group of that name; an AttributeError, as Python expects it."""


class Members:
    """Looks services up for groups. Shared by a group and the groups beneath it."""

    def __init__(
        self,
        select: Callable[[Constraint], Sequence[Record]],
        await_services: Callable[[Constraint, Callable[[], bool], float], None],
        handle: Callable[[Record], Handle],
        *,
        wait_s: float,
        follow: bool,
    ) -> None:
        self._select = select
        self._await = await_services
        self.handle = handle
        self._wait_s = wait_s
        self.follow = follow
        self._views: dict[ServiceKey, tuple[weakref.ref[GroupView], str]] = {}
        """The attributes that are forgotten when their service leaves."""

    def keep(self, handle: Handle, of: "GroupView", name: str) -> None:
        """Forget an attribute of a group once its service has left."""
        self._views[handle.key] = (weakref.ref(of), name)
        if not handle.alive:  # it has left meanwhile
            self.forget([handle.key])

    def forget(self, left: Iterable[ServiceKey]) -> None:
        """These services have left."""
        for key in left:
            view, name = self._views.pop(key, (None, ""))
            of = None if view is None else view()
            if of is not None:
                vars(of).pop(name, None)

    def records(self, beneath: Constraint) -> Sequence[Record]:
        """The services that exist now."""
        return self._select(beneath)

    def service(self, beneath: Constraint, group: str | None, name: str) -> Record | None:
        """The service of that name in exactly this group, or of any group if it is None."""
        found = [one for one in self._select(beneath) if one.name == name and (group is None or group in one.groups)]
        if len(found) > 1:
            raise too_many_services(beneath, found)
        return found[0] if found else None

    def await_member(self, wanted: Constraint, ready: Callable[[], bool]) -> None:
        """Waits for a service. Raises NoSuchService."""
        self._await(wanted, ready, self._wait_s)


class GroupView:
    """What is beneath a group, as attributes: its services are handles, the groups beneath it are groups.

    A name that is a word of Python gets an underscore, ``rosie.import_``. Any name can be an index, as in
    ``rosie["left-arm"]``.

    Raises:
        NoSuchService: an attribute is neither a service nor a group; also an AttributeError.
        TooManyServices: an attribute is a service of several providers, such as two robots of one name.
        ConfigurationError: an attribute is a service and a group.
    """

    _members: Members
    _beneath: Constraint
    _group: str | None
    _label: str

    def __init__(self, members: Members, beneath: Constraint, group: str | None, label: str) -> None:
        self.__dict__.update(_members=members, _beneath=beneath, _group=group, _label=label)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"{self!r} has no attribute {name!r}")
        member = self.__dict__[name] = self._member(name)
        if self._members.follow and isinstance(member, Handle):
            self._members.keep(member, self, name)
        return member

    def __getitem__(self, path: str) -> Any:
        if not isinstance(path, str) or not path:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ConfigurationError(where=repr(self), problem=f"an index is a name such as 'neck.pan', not {path!r}")
        member: Any = self
        for name in path.split("."):
            member = member._member(name) if isinstance(member, GroupView) else getattr(member, name)
        return member

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"{self!r} cannot be changed; services and groups are registered by their providers")

    def __dir__(self) -> Iterable[str]:
        return [*super().__dir__(), *(f"{name}_" if keyword.iskeyword(name) else name for name in self._names())]

    def __repr__(self) -> str:
        names = sorted(set(self._names()))
        more = f" and {len(names) - _MOST_SHOWN} more" if len(names) > _MOST_SHOWN else ""
        return f"<GroupView {self._label}: {', '.join(names[:_MOST_SHOWN]) or 'nothing'}{more}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError(f"{self!r} cannot be pickled: it belongs to its container; call trade.robot(...) there")

    def _names(self) -> Iterator[str]:
        """Names of services, and of groups one level beneath."""
        own = self._group
        for record in self._members.records(self._beneath):
            if own is None or own in record.groups:
                yield record.name
            if own is not None:
                beneath = (group.removeprefix(f"{own}.") for group in record.groups if group.startswith(f"{own}."))
                yield from (rest.partition(".")[0] for rest in beneath)

    def _member(self, name: str) -> "Handle | GroupView":
        """The service or the group of that name; waits for it."""
        found: list[Handle | GroupView] = []

        def look() -> bool:
            found[:] = self._present(name) or self._present(name.removesuffix("_"))
            return bool(found)

        if not look():
            try:
                self._members.await_member(self._beneath, look)
            except NoSuchService as missing:
                raise self._missing(name, missing) from None
        return found[0]

    def _present(self, name: str) -> "list[Handle | GroupView]":
        record = self._members.service(self._beneath, self._group, name)
        label = f"{self._label}.{name}"
        under = None if self._group is None else f"{self._group}.{name}"
        groups = {group for one in self._members.records(self._beneath) for group in one.groups}
        is_group = under is not None and any(f"{group}.".startswith(f"{under}.") for group in groups)
        if record is not None and is_group:
            problem = f"is a service and a group; write trade.find({label!r}) or trade.robot({label!r})"
            raise ConfigurationError(where=label, problem=problem)
        if record is not None:
            return [self._members.handle(record)]
        return [GroupView(self._members, self._beneath, under, label)] if is_group else []

    def _missing(self, name: str, missing: NoSuchService) -> NoSuchMember:
        near = difflib.get_close_matches(name, sorted(set(self._names())), n=2)
        return NoSuchMember(
            constraint=f"{self._label}.{name}",
            waited_s=missing.waited_s,
            near=[f"{self._label}.{one}" for one in near] or missing.near,
            groups=missing.groups,
            apart=missing.apart,
            hidden=missing.hidden,
        )
