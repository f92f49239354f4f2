"""Messages of clients that change the system, and what they show of it first."""

from typing import Annotated, Any

from msgspec import Meta, Struct

from trade_gateway.clients._schemas import Group

Name = Annotated[str, Meta(min_length=1, max_length=80)]
Pattern = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.@:?*-]{1,80}$")]
NewGroup = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]+([.][A-Za-z0-9_-]+)*$", max_length=200)]


class ReasonBody(Struct, forbid_unknown_fields=True, kw_only=True):
    reason: Annotated[str, Meta(max_length=200)] = ""


class MigrateBody(Struct, forbid_unknown_fields=True, kw_only=True):
    group: Group
    name: str = ""
    """A service of the provider, if the group has several providers."""
    container: str = ""
    """Where the provider is, if several containers have the group."""
    to: Pattern
    """Container; with ``*`` or ``?``, the least busy match."""


class ProviderBody(Struct, forbid_unknown_fields=True, kw_only=True):
    group: Group
    name: str = ""
    container: str = ""


class InstantiateBody(Struct, forbid_unknown_fields=True, kw_only=True):
    container: Name
    class_path: Annotated[str, Meta(min_length=1, max_length=400)]
    """``module:Class``; the container must allow it."""
    args: dict[str, Any] = {}
    """For its constructor, by name."""
    groups: Annotated[list[NewGroup], Meta(max_length=20)] = []


class TextBody(Struct, forbid_unknown_fields=True, kw_only=True):
    text: str
    """The whole contents of a file."""


class FileBody(TextBody, kw_only=True):
    version: Annotated[str, Meta(max_length=80)]
    """Of the contents that it was made from."""


class FileView(Struct, frozen=True):
    container: str
    """The container that uses it; empty: the HTTP gateway."""
    path: str
    text: str
    version: str


class Trial(Struct, frozen=True):
    """What a changed file would do; nothing was changed."""

    problem: str
    """Why it would be refused; empty if it would not."""
    diff: list[str]
    """The lines in which it differs, as a unified diff."""
    effects: list[str]
    """What would be different, or what each rule would do now."""


class ContainerState(Struct, frozen=True, kw_only=True):
    """A container of the system, or what a gateway supervises although it is none, or not at the moment."""

    name: str
    identity: str = ""
    """Empty if it is no container now."""
    host: str = ""
    """Empty without a process."""
    own: bool = False
    """Whether it is the HTTP gateway itself."""
    services: int = 0
    """The number of services, without those of the middleware."""
    actuating: int = 0
    """How many of them move something."""
    groups: tuple[str, ...] = ()
    """The groups there that the client may see."""
    links: tuple[str, ...] | None = None
    """The containers at the other ends of its links; None: it does not report them, or not to this client."""
    discovery: bool | None = None
    broadcast: bool | None = None
    supervised_by: str = ""
    """The gateway that restarts it if it ends."""
    supervises: tuple[str, ...] = ()
    state: str = ""
    """What its gateway says of it."""
    restarts: int = 0
    why: str = ""
    """Why it ended."""


class Done(Struct, frozen=True):
    """What a change did."""

    text: str
