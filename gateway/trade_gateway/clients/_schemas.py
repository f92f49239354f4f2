"""Messages of clients and answers to them, over HTTP and WebSocket: records, decoded strictly."""

import sys
from typing import Annotated, Any, Final, Literal, TypeVar, cast

import msgspec
from msgspec import Meta, Struct

from trade import Handle, LockInfo, Span
from trade.policies import VERBS, Policy
from trade_gateway.clients._errors import BadMessage

T = TypeVar("T")

APPROVALS: Final = "approvals"
"""Group of the services for pending approvals."""

MOST_DEADLINE_S: Final = 86_400.0
SESSION_LEASE_S: Final = 2.0
LEAST_INTEGER: Final = -(2**63)
MOST_INTEGER: Final = 2**64 - 1
_MOST_DEEP: Final = 100
"""The deepest nesting of arguments."""
_MOST_EXACT: Final = 2**53

Deadline = Annotated[float, Meta(gt=0, le=MOST_DEADLINE_S)]
Group = Annotated[str, Meta(min_length=1, max_length=200)]
Arguments = list[Any] | dict[str, Any]
Occasion = Literal["joined", "left", "changed"]
Id = Annotated[str, Meta(max_length=80)] | int


# --- bodies


class CallBody(Struct, forbid_unknown_fields=True, kw_only=True):
    args: Arguments = {}
    """Positional (a list) or named (an object)."""
    deadline_s: Deadline = 10.0
    container: str = ""
    """Only the service of this container."""


class LockBody(Struct, forbid_unknown_fields=True, kw_only=True):
    group: Group
    """The actuating services of this group and beneath it."""
    purpose: Annotated[str, Meta(max_length=200)] = ""
    wait_s: Annotated[float, Meta(ge=0, le=60)] = 10.0
    partial: bool = False


class GroupBody(Struct, forbid_unknown_fields=True, kw_only=True):
    group: Group


class RequestBody(Struct, forbid_unknown_fields=True, kw_only=True):
    resources: Annotated[list[str], Meta(min_length=1, max_length=200)]
    """Names from ``GET /locks``."""
    reason: Annotated[str, Meta(max_length=200)] = ""


class EstopBody(Struct, forbid_unknown_fields=True, kw_only=True):
    reason: Annotated[str, Meta(max_length=300)] = ""


class ClearBody(Struct, forbid_unknown_fields=True, kw_only=True):
    ids: list[str] = []
    """None: all open e-stops."""


class SwitchBody(Struct, forbid_unknown_fields=True, kw_only=True):
    on: bool


class SessionBody(Struct, forbid_unknown_fields=True, kw_only=True):
    lease_s: Annotated[float, Meta(ge=0.2, le=60)] = SESSION_LEASE_S
    """Time after its last request until the session and its motion end, in seconds."""


# --- messages of the WebSocket


class Call(CallBody, tag="call", tag_field="do", kw_only=True):
    id: Id
    group: Group
    name: str


class TakeLock(LockBody, tag="lock", tag_field="do", kw_only=True):
    id: Id


class Unlock(Struct, tag="unlock", tag_field="do", forbid_unknown_fields=True, kw_only=True):
    id: Id
    lock: str


class Resume(GroupBody, tag="resume", tag_field="do", kw_only=True):
    id: Id


class Estop(EstopBody, tag="estop", tag_field="do", kw_only=True):
    id: Id


class Stream(Struct, tag="stream", tag_field="do", forbid_unknown_fields=True, kw_only=True):
    id: Id
    group: Group
    name: str
    hz: Annotated[float, Meta(ge=0.001, le=1000)] = 10.0
    on_change: bool = False
    container: str = ""


class Watch(Struct, tag="watch", tag_field="do", forbid_unknown_fields=True, kw_only=True):
    id: Id
    group: Group | None = None
    name: str | None = None
    occasions: tuple[Occasion, ...] = ("joined", "left", "changed")
    existing: bool = False
    """Whether present services are also reported, as joined."""


class Logs(Struct, tag="logs", tag_field="do", forbid_unknown_fields=True, kw_only=True):
    id: Id
    level: Annotated[int, Meta(ge=0, le=100)] = 20
    """The lowest level, in Python's numbers: 20 is info, 30 warning, 40 error."""


class Calls(Struct, tag="calls", tag_field="do", forbid_unknown_fields=True, kw_only=True):
    id: Id
    reads: bool = False
    """Whether calls of services that only read are included; streams make many of them."""


class Cancel(Struct, tag="cancel", tag_field="do", forbid_unknown_fields=True, kw_only=True):
    id: Id
    which: Id
    """The call, stream, watch, log or list of calls to end."""


Asked = Call | TakeLock | Unlock | Resume | Estop | Stream | Watch | Logs | Calls | Cancel


# --- answers


class Me(Struct, frozen=True):
    identity: str
    administers: bool
    """Over the system: it may clear e-stops."""
    reads: bool
    """Over the system: it may read its log, calls, notifications, hooks and policy."""
    instruments: bool
    """Over the system: it may turn tracing on and off."""
    over: tuple[str, ...] = ("*",)
    """The groups that it may administer, with all beneath them; ``*``: all."""


class ServiceView(Struct, frozen=True):
    group: str
    """Group and name identify the service in a call."""
    name: str
    groups: tuple[str, ...]
    signature: str
    doc: str
    effect: str
    needs: tuple[str, ...]
    achieves: tuple[str, ...]
    resources: tuple[str, ...]
    health: str
    container: str
    host: str
    allowed: bool
    """Whether the asking client may call it."""


class CallView(Struct, frozen=True):
    """A call that has ended, as recorded by its calling or its serving container."""

    id: str
    """As text: it exceeds the range of numbers in JavaScript."""
    service: str
    side: str
    container: str
    caller: str
    session: str
    began: float
    took_s: float
    outcome: str


class AuditView(Struct, frozen=True, kw_only=True):
    """A row of the audit record."""

    at: float
    container: str
    kind: str
    what: str
    about: str
    who: str
    session: str
    outcome: str
    why: str
    call_id: str


class IdentityView(Struct, frozen=True):
    """The rights of an identity, or of all that match a pattern."""

    name: str
    roles: tuple[str, ...]
    rights: dict[str, list[str]]
    """Groups by right."""


class PolicyView(Struct, frozen=True):
    governed: bool
    """Whether there is a policy; without one everything is allowed."""
    identities: tuple[IdentityView, ...]
    revoked: tuple[str, ...]


class ContainerView(Struct, frozen=True):
    name: str
    identity: str
    host: str


class LockView(Struct, frozen=True):
    resources: tuple[str, ...]
    container: str
    owner: str
    """``identity/container``, or the client of an HTTP gateway behind it."""
    purpose: str
    since: float
    waiting: tuple[str, ...]


class LockTaken(Struct, frozen=True):
    lock: str
    """The name that releases it."""
    resources: tuple[str, ...]
    missing: tuple[str, ...] = ()
    """Resources of the group that were missing; only with ``partial``."""


class SessionOpened(Struct, frozen=True):
    session: str
    """To be sent as ``Trade-Session``; a secret of the client."""
    name: str
    """Its name for other clients."""
    lease_s: float


class EstopView(Struct, frozen=True):
    id: str
    by: str
    reason: str
    at: float
    told_by: str = ""
    """The container that reported it, if this is not its giver: the report may be false."""


class Stopped(Struct, frozen=True):
    id: str
    complete: bool
    confirmed: tuple[str, ...]
    missing: tuple[str, ...]
    failed: dict[str, str]
    apart: dict[str, str] = {}
    """Endpoints that the gateway dials without an answer: containers there did not receive the e-stop."""


def service_view(handle: Handle, *, allowed: bool) -> ServiceView:
    return ServiceView(
        handle.key.domain,
        handle.name,
        handle.groups,
        handle.signature,
        handle.doc,
        handle.effect,
        handle.needs,
        handle.achieves,
        handle.resources,
        handle.health,
        handle.container,
        handle.host,
        allowed,
    )


def call_view(span: Span) -> CallView:
    return CallView(
        str(span.call_id),
        span.service,
        span.side,
        span.container,
        span.caller,
        span.session,
        span.began,
        span.took_s,
        span.outcome,
    )


def policy_view(policy: Policy | None) -> PolicyView:
    if policy is None:
        return PolicyView(governed=False, identities=(), revoked=())
    found = (
        IdentityView(name, policy.roles_of(name), {verb: policy.groups_of(name, (verb,)) for verb in VERBS})
        for name in policy.identities
    )
    return PolicyView(governed=True, identities=tuple(found), revoked=tuple(sorted(policy.revoked)))


def lock_view(info: LockInfo) -> LockView:
    holder = info.holder
    client = holder.session.partition(f"{holder.container}/")[2].partition("/")[2]
    own = client and ":" not in client  # of another system: its owner contains the client already
    owner = f"{holder.owner} for {client.rpartition('.')[0]}" if own else holder.owner
    return LockView(info.resources, info.container, owner, holder.purpose, holder.since, info.waiting)


def plain(value: Any) -> Any:
    """Converts values that JSON does not have."""
    if isinstance(value, Handle):
        return {"service": value.label, "container": value.container}
    raise TypeError(f"a {type(value).__qualname__} cannot be expressed in JSON")


def numbers(value: Any, deep: int = 0) -> Any:
    """Normalises numbers, as JSON has one kind: 2.0 becomes an integer, and an integer out of range a float.

    Raises ValueError: it is nested more than ``_MOST_DEEP`` deep.
    """
    if deep > _MOST_DEEP:
        raise ValueError(f"nested more than {_MOST_DEEP} deep")
    match value:
        case dict():
            return {key: numbers(inner, deep + 1) for key, inner in cast("dict[str, Any]", value).items()}
        case list():
            return [numbers(inner, deep + 1) for inner in cast("list[Any]", value)]
        case float() if value.is_integer() and abs(value) < _MOST_EXACT:
            return int(value)
        case int() if not LEAST_INTEGER <= value <= MOST_INTEGER and abs(value) < sys.float_info.max:
            return float(value)
        case _:
            return value


def read(text: str | bytes, decoder: msgspec.json.Decoder[T]) -> T:
    """Decodes a message of a client. Raises BadMessage: it is not JSON, or has the wrong structure."""
    try:
        return decoder.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as bad:
        raise BadMessage(problem=str(bad)) from None


NO_JSON: Final = (TypeError, ValueError, OverflowError, RecursionError)
"""What encoding raises for values that JSON does not have."""
encoder: Final = msgspec.json.Encoder(enc_hook=plain)
ASKED: Final[msgspec.json.Decoder[Asked]] = msgspec.json.Decoder(Asked)
