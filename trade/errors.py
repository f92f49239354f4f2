"""The error tree: one root, with branches by who must act.

    TradeError
    |-- CallerError            the caller must act
    |   |-- NoSuchService, TooManyServices, ServiceGone                 finding a service
    |   |-- InvalidArgument, NotSerialisable, TooLarge, LimitExceeded   what the caller passed
    |   |-- DeadlineExceeded, OutcomeUnknown, Cancelled                 how the call ended
    |   |-- MotionStopped, Stopped, NoSuchEstop                         stops
    |   |-- LockedByOther, LockLost, NotLocked, IncompleteGroup         locks
    |   |-- AccessDenied, CallRefused, SessionEnded, InUse              rights, guards, sessions and containers
    |   |-- NoSuchNotification, NoSuchHook, NoSuchCall                  ids
    |   `-- NotInstantiable, NoSuchClass                                objects created on request
    |-- CallError              the other side of a call failed
    |   |-- Busy, InvalidResult, RemoteError
    |   |-- ContainerLost
    |   |   `-- SourceLost
    |   `-- CannotInstantiate, CannotMigrate, MigrationUnknown
    |-- DeviceError            a device failed
    |   |-- DeviceFault, ToleranceExceeded
    |   `-- DeviceSilent
    |       |-- BusGone
    |       |   `-- SendQueueFull
    |       `-- NotStopped
    `-- SetupError             the installation or the configuration must change
        |-- ConfigurationError
        |   `-- WrongDevice, DeviceAbsent
        `-- CannotConnect, NoContainerFound, CannotStart, LinkStays

Every error carries its data as attributes, crosses the wire with them, and says what to do next: `str` for
programs, `at_terminal` for people. Each also inherits the builtin that a Python programmer would catch
for it, so ``except TimeoutError`` catches a deadline that passed.

All errors are in one module, so that a reader sees the whole tree.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final, Literal, NamedTuple, TypeVar

from trade.timestamps import clock

__all__ = [
    "AccessDenied",
    "BusGone",
    "Busy",
    "CallError",
    "CallRefused",
    "CallerError",
    "Cancelled",
    "CannotConnect",
    "CannotInstantiate",
    "CannotMigrate",
    "CannotStart",
    "CodeRefused",
    "ConfigurationError",
    "ContainerLost",
    "DeadlineExceeded",
    "DeviceAbsent",
    "DeviceError",
    "DeviceFault",
    "DeviceSilent",
    "InUse",
    "IncompleteGroup",
    "InvalidArgument",
    "InvalidResult",
    "LimitExceeded",
    "LinkStays",
    "LockLost",
    "LockedByOther",
    "MigrationUnknown",
    "MotionStopped",
    "NoContainerFound",
    "NoSuchCall",
    "NoSuchClass",
    "NoSuchEstop",
    "NoSuchHook",
    "NoSuchNotification",
    "NoSuchService",
    "NotInstantiable",
    "NotLocked",
    "NotSerialisable",
    "NotStopped",
    "OutcomeUnknown",
    "RemoteError",
    "SendQueueFull",
    "ServiceGone",
    "SessionEnded",
    "SetupError",
    "SourceLost",
    "Stopped",
    "ToleranceExceeded",
    "TooLarge",
    "TooManyServices",
    "TradeError",
    "WrongDevice",
]


_SHORTEST_SILENCE_S: Final = 0.1
"""A shorter silence is one exchange on a bus: messages omit its length."""
_NO_MORE_TENTHS_S: Final = 10.0


_NEVER_RAN: Final = "_never_ran"
_Error = TypeVar("_Error", bound="TradeError")


@dataclass(kw_only=True, eq=False)
class TradeError(Exception):
    """The root of all errors that this project raises on purpose."""

    def __str__(self) -> str:
        advice = self.advice()
        return self.describe() if advice is None else f"{self.describe()}{advice.joint}{advice.call}"

    def describe(self) -> str:
        """What happened, and why; also what to do, if that is the same in a program and at a terminal."""
        return type(self).__name__

    def advice(self) -> "Advice | None":
        """What to do, if that differs between the two."""
        return None

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), {f.name: getattr(self, f.name) for f in fields(self)})


class Advice(NamedTuple):
    """What to do about an error."""

    call: str
    """In a program of Python."""
    command: str
    """At a terminal."""
    joint: str = ". "
    """What separates it from the rest of the message."""


_MORE_TIME: Final = Advice(
    "Give it more time with handle.with_(deadline_s=...)", "Give it more time with --deadline SECONDS"
)
_METHOD: Final = re.compile(r"(?:\bcall )?\b([a-z_]+)\(\)")


def as_commands(device: str, remedy: str) -> str:
    """Turns a driver's remedy into commands: ``call enable()`` becomes ``trade call rosie.neck.pan.enable``."""
    return _METHOD.sub(lambda found: f"`trade call {device}.{found[1]}`", remedy)


def at_terminal(error: BaseException) -> str:
    """The message of an error, with commands instead of functions of Python."""
    if isinstance(error, DeviceFault):
        return as_commands(error.device, str(error))
    if not isinstance(error, TradeError) or (advice := error.advice()) is None:
        return str(error)
    return f"{error.describe()}{advice.joint}{advice.command}"


def never_ran(error: TradeError, key: object) -> bool:
    """Whether it is certain that a call of the service with that key did not begin, so that another one may be called.

    An error of the same type may come from the service itself, which has then run.
    """
    return vars(error).get(_NEVER_RAN) == key


def as_never_ran(error: _Error, key: object) -> _Error:
    """The error of a call of that service that did not begin. The mark does not cross the wire."""
    setattr(error, _NEVER_RAN, key)
    return error


def _rebuild(cls: type[TradeError], data: dict[str, object]) -> TradeError:
    return cls(**data)


def _some(texts: Sequence[str]) -> str:
    """The first five, as a list in prose."""
    return ", ".join(list(texts)[:5]) + (", ..." if len(texts) > 5 else "")


def _unanswered(apart: Sequence[str]) -> str:
    """The endpoints at which no container answers, with the reasons."""
    return "; ".join(f"no container answers at {endpoint}" for endpoint in apart)


def _for(seconds: float) -> str:
    """The length of a silence; empty if it is too short to matter."""
    if seconds < _SHORTEST_SILENCE_S:
        return ""
    return f" for {seconds:.1f} s" if seconds < _NO_MORE_TENTHS_S else f" for {seconds:.0f} s"


# --- the caller must act


@dataclass(kw_only=True, eq=False)
class CallerError(TradeError):
    """The caller asked for something that it cannot have."""


@dataclass(kw_only=True, eq=False)
class NoSuchService(CallerError, LookupError):
    """Nothing in the system matches the constraint."""

    constraint: str
    waited_s: float = 0.0
    near: Sequence[str] = ()
    groups: Sequence[str] = ()
    """Some of the groups in the system."""
    apart: Sequence[str] = ()
    """Endpoints where no container was found, each with the reason, if this container found no other one."""
    hidden: str = ""
    """Why the policy would hide a matching service from this container; empty if it would not."""
    beyond: Sequence[str] = ()
    """What other containers see and this one does not, as sentences."""

    def describe(self) -> str:
        return f"no service matches {self.constraint} after {self.waited_s:.3g} s. {self._hint()}"

    def _hint(self) -> str:
        if self.hidden:
            return f"{self.hidden}, so such services are hidden here. Ask the policy's maintainer for access"
        if self.beyond:
            return "; ".join(self.beyond)
        if self.near:
            return f"Did you mean {' or '.join(self.near)}?"
        if self.groups:
            return f"This system has {_some(self.groups)}; `trade services` lists their services"
        if self.apart:
            return f"This container has found no other one: {_unanswered(self.apart)}"
        return "No services are registered in this system. Is the provider running with the same TRADE_SYSTEM?"


@dataclass(kw_only=True, eq=False)
class TooManyServices(CallerError, LookupError):
    """More than one service matches where exactly one was wanted."""

    constraint: str
    matches: Sequence[str]
    differ: Sequence[str] = ()
    """Keywords of ``where`` that distinguish some of them."""

    def describe(self) -> str:
        if self.differ:
            remedy = f"Add a constraint on what distinguishes them ({', '.join(self.differ)})"
        else:
            remedy = "No constraint distinguishes them. Register them in different groups or with different meta"
        return f"{len(self.matches)} services match {self.constraint}: {_some(self.matches)}. {remedy}"

    def advice(self) -> Advice:
        return Advice("take them all with trade.services(...)", "see all of them with `trade services`", ", or ")


@dataclass(kw_only=True, eq=False)
class ServiceGone(CallerError, LookupError):
    """The service behind this handle was deregistered, or its container has ended or restarted."""

    service: str
    reason: str = "its provider was deregistered"
    moved_to: str = ""
    """Where its provider is now, if it moved: ``identity/container/epoch/domain/provider``. Handles do not follow."""

    def describe(self) -> str:
        return f"{self.service} is gone: {self.reason}"

    def advice(self) -> Advice:
        return Advice("Look it up again with trade.find(...)", "`trade services` lists all services")


@dataclass(kw_only=True, eq=False)
class InvalidArgument(CallerError, ValueError, TypeError):
    """An argument does not fit the service's signature; no code of the provider ran."""

    service: str
    argument: str
    problem: str
    signature: str = ""
    late: bool = False
    """Whether its call has too little time for it."""

    def describe(self) -> str:
        where = f" argument {self.argument!r}" if self.argument else ""
        tail = f". Call it as {self.signature}" if self.signature else ""
        return f"{self.service}{where}: {self.problem}{tail}"

    def advice(self) -> Advice | None:
        return _MORE_TIME if self.late else None


@dataclass(kw_only=True, eq=False)
class LimitExceeded(CallerError, ValueError):
    """A commanded value is outside a configured limit; it was refused, not clipped."""

    what: str
    value: float
    lower: float
    upper: float
    unit: str = ""

    def describe(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.what}: {self.value:.6g}{unit} is outside {self.lower:.6g} to {self.upper:.6g}{unit}; nothing moved"
            ". Command a value inside, or change the limit in the robot file"
        )


@dataclass(kw_only=True, eq=False)
class NotSerialisable(CallerError, TypeError):
    """A value cannot be sent, because it is not plain data, a struct, a dataclass, an enum or a handle."""

    service: str
    what: str
    problem: str

    def describe(self) -> str:
        return f"{self.service}: {self.what} cannot be sent: {self.problem}. Use plain data, a struct or a handle"


@dataclass(kw_only=True, eq=False)
class TooLarge(CallerError, ValueError):
    """Arguments or a result are larger than a message may be; nothing was sent."""

    service: str
    what: str
    size_bytes: int
    limit_bytes: int

    def describe(self) -> str:
        size, limit = self.size_bytes / (1 << 20), self.limit_bytes / (1 << 20)
        return (
            f"{self.service}: {self.what} of {size:.1f} MiB ({self.size_bytes} bytes) cannot be sent. The limit is "
            f"{limit:.0f} MiB. Send smaller parts"
        )


@dataclass(kw_only=True, eq=False)
class DeadlineExceeded(CallerError, TimeoutError):
    """The deadline passed before the service began; it did not run and will not."""

    service: str
    deadline_s: float

    def describe(self) -> str:
        return f"{self.service} did not run: its deadline of {self.deadline_s:.3g} s had passed before it could begin"


@dataclass(kw_only=True, eq=False)
class OutcomeUnknown(CallerError, TimeoutError):
    """The deadline passed without an answer; the service may have run, may be running, or may not have."""

    service: str
    deadline_s: float

    def describe(self) -> str:
        return (
            f"no answer from {self.service} within {self.deadline_s:.3g} s. Whether it ran is unknown. Check its "
            "state before you try again"
        )

    def advice(self) -> Advice:
        return Advice("handle.with_(deadline_s=...) waits longer", "--deadline SECONDS waits longer", "; ")


@dataclass(kw_only=True, eq=False)
class MotionStopped(CallerError, RuntimeError):
    """A motion was stopped before its goal; the joint holds where it stopped."""

    device: str
    reason: str
    late: bool = False
    """Whether its call reached its deadline."""

    def describe(self) -> str:
        return f"{self.device} stopped before its goal: {self.reason}. It holds its position"

    def advice(self) -> Advice | None:
        return _MORE_TIME if self.late else None


@dataclass(kw_only=True, eq=False)
class Stopped(CallerError, RuntimeError):
    """A stop by another client holds until it is resumed; nothing moves before that."""

    resource: str
    by: str
    reason: str
    estop: bool = False
    """Whether an e-stop is open."""
    cleared: bool = False
    """Whether the stop was an e-stop that is cleared now; what it stopped still has to be resumed."""
    others: Sequence[str] = ()
    """The other resources of the call that have to be resumed, too."""

    def describe(self) -> str:
        cleared = ". That e-stop is cleared, but what it stopped was not resumed yet" if self.cleared else ""
        return f"{self.resource} was stopped by {self.by}: {self.reason}{cleared}"

    def advice(self) -> Advice:
        once = "When it is safe to move, call"
        if self.estop:
            return Advice(f"{once} `trade estop --clear`", f"{once} `trade estop --clear`")
        command = f"`trade resume {' '.join((self.resource, *self.others))}`"
        return Advice(f"{once} trade.resume(...) or {command}", f"{once} {command}")


@dataclass(kw_only=True, eq=False)
class NoSuchEstop(CallerError, LookupError):
    """No container in the system has an open e-stop of that id; nothing was cleared."""

    ids: Sequence[str]
    open: Sequence[str]
    """The ids of the open ones."""

    def describe(self) -> str:
        there = f"Open e-stops: {_some(self.open)}" if self.open else "No e-stop is open"
        return f"there is no open e-stop {', '.join(self.ids)}. {there}"


@dataclass(kw_only=True, eq=False)
class NoSuchNotification(CallerError, LookupError):
    """No known container has a notification of that id."""

    id: str

    def describe(self) -> str:
        return f"there is no notification {self.id}. It has ended or was cancelled; `trade notifications` lists them"


@dataclass(kw_only=True, eq=False)
class NoSuchHook(CallerError, LookupError):
    """No known container has a hook of that id."""

    id: str

    def describe(self) -> str:
        return f"there is no hook {self.id}. It was detached, or its owner has ended; `trade hooks` lists them"


@dataclass(kw_only=True, eq=False)
class NoSuchCall(CallerError, LookupError):
    """No container has traced a call of that id."""

    id: int

    def describe(self) -> str:
        return (
            f"no container has traced call {self.id}. Its containers are not traced (`trade tracing on`), it has not "
            "ended, or newer calls have replaced it"
        )


@dataclass(kw_only=True, eq=False)
class NotInstantiable(CallerError, PermissionError):
    """The container's settings do not allow it to create objects of that class; nothing was imported."""

    class_path: str
    container: str
    allowed: Sequence[str] = ()

    def describe(self) -> str:
        allowed = f"only {_some(self.allowed)}" if self.allowed else "no class"
        return (
            f"container {self.container} may not create a {self.class_path}. It allows {allowed}. Start it with "
            f"`trade container --allow {self.class_path}`, or set TRADE_INSTANTIABLE"
        )


@dataclass(kw_only=True, eq=False)
class CodeRefused(CallerError, PermissionError):
    """A container does not take code that was brought to it; nothing was imported."""

    sha256: str
    container: str
    reason: str

    def describe(self) -> str:
        return f"container {self.container} does not take the code with SHA-256 {self.sha256}: {self.reason}"


@dataclass(kw_only=True, eq=False)
class NoSuchClass(CallerError, LookupError):
    """The container's Python has no class of that path."""

    class_path: str
    container: str
    reason: str

    def describe(self) -> str:
        return (
            f"container {self.container} has no class {self.class_path}: {self.reason}. Is its package installed "
            "there, and is the path package.module:Class?"
        )


@dataclass(kw_only=True, eq=False)
class AccessDenied(CallerError, PermissionError):
    """The access policy forbids it; nothing was done."""

    who: str
    """The identity that asked."""
    verb: str
    what: str
    """The group, or the service."""
    rule: str
    """Why the policy forbids it."""

    def describe(self) -> str:
        return (
            f"{self.who} may not {self.verb} {self.what}: {self.rule}. "
            "`trade policy show` lists all rights. Ask the policy's maintainer for access"
        )


@dataclass(kw_only=True, eq=False)
class CallRefused(CallerError, PermissionError):
    """A guard of the service did not let the call run; nothing was done."""

    service: str
    guard: str
    """The name of the guard's check."""
    reason: str

    def describe(self) -> str:
        return f"{self.service} was refused by its guard {self.guard}: {self.reason}"


@dataclass(kw_only=True, eq=False)
class LockedByOther(CallerError, PermissionError):
    """Another client has locked it."""

    resources: Sequence[str]
    owner: str
    purpose: str = ""
    since: float = 0.0
    """Seconds since the epoch, by the clock of the container that granted it."""
    own: bool = False
    """Whether the owner is this same container, in another thread or task."""

    def describe(self) -> str:
        what = ", ".join(self.resources)
        aim = f" for {self.purpose!r}" if self.purpose else ""
        when = f" since {clock(self.since)}" if self.since else ""
        own = ". That is this container itself. Make the call inside `with lock.use():`" if self.own else ""
        return f"{what} is locked by {self.owner}{aim}{when}{own}"

    def advice(self) -> Advice | None:
        if self.own:
            return None
        return Advice(
            "Wait with trade.lock(..., wait_s=...) or ask with trade.request_release(...)",
            "Wait with `trade lock --wait SECONDS`, or take it away with `trade unlock GROUP --break REASON`",
        )


@dataclass(kw_only=True, eq=False)
class InUse(CallerError, PermissionError):
    """A container was to end only if none of its resources is locked or moves; nothing was done."""

    container: str
    uses: Sequence[str]

    def describe(self) -> str:
        return f"container {self.container} is in use: {'; '.join(self.uses)}. Wait, or ask the user to release it"


@dataclass(kw_only=True, eq=False)
class LockLost(CallerError, ConnectionError):
    """The caller's lock no longer holds; the call did not run, and any motion under the lock is stopped."""

    resources: Sequence[str]
    reason: str

    def describe(self) -> str:
        return f"the lock of {', '.join(self.resources)} is lost: {self.reason}"

    def advice(self) -> Advice:
        return Advice("Take it again with trade.lock(...)", "Take it again with `trade lock`")


@dataclass(kw_only=True, eq=False)
class SessionEnded(CallerError, ConnectionError):
    """The caller's session has ended: the call did not run, and any motion of that session is stopped."""

    session: str
    reason: str

    def describe(self) -> str:
        return f"session {self.session} has ended: {self.reason}. Open another one with trade.open_session(...)"


@dataclass(kw_only=True, eq=False)
class IncompleteGroup(CallerError, LookupError):
    """Members of a robot's group, or alternatives of a constraint, are missing, so it cannot be locked as a whole."""

    group: str
    missing: Sequence[str]

    def describe(self) -> str:
        return f"{self.group} is not complete: {', '.join(self.missing)} missing. Start the missing drivers"

    def advice(self) -> Advice:
        return Advice("lock the rest with partial=True", "lock the rest with --partial", ", or ")


@dataclass(kw_only=True, eq=False)
class NotLocked(CallerError, PermissionError):
    """The lock around a command selects the service but does not hold it; nothing was sent."""

    service: str
    selected_by: str
    """The constraint of the lock."""

    def describe(self) -> str:
        return (
            f"{self.service} is selected by the lock of {self.selected_by}, which does not hold it: it joined after "
            "the lock was taken. Release the lock and take it again"
        )


@dataclass(kw_only=True, eq=False)
class Cancelled(CallerError):
    """The call was cancelled by its caller before it finished."""

    service: str

    def describe(self) -> str:
        return f"the call of {self.service} was cancelled"


# --- the other side of a call failed


@dataclass(kw_only=True, eq=False)
class CallError(TradeError):
    """The other side of a call failed."""


@dataclass(kw_only=True, eq=False)
class ContainerLost(CallError, ConnectionError):
    """The container ended or became unreachable while the call was under way; whether it ran is unknown."""

    service: str
    container: str

    def describe(self) -> str:
        return (
            f"container {self.container} was lost during a call of {self.service}. Whether it ran is unknown. "
            "Find the service again and check its state"
        )


@dataclass(kw_only=True, eq=False)
class SourceLost(ContainerLost):
    """The container that publishes a stream ended or became unreachable."""

    def describe(self) -> str:
        return (
            f"container {self.container} was lost during a stream of {self.service}. Samples resume when it is back. "
            "If it was restarted, find the service again and open another stream"
        )


@dataclass(kw_only=True, eq=False)
class Busy(CallError, BlockingIOError):
    """All handler threads of the container are busy; nothing ran."""

    service: str
    container: str

    def describe(self) -> str:
        return f"{self.service} did not run: container {self.container} has no free handler thread. Try again shortly"


@dataclass(kw_only=True, eq=False)
class CannotInstantiate(CallError, RuntimeError):
    """The class raised an exception on import or creation; nothing was registered."""

    class_path: str
    container: str
    problem: str

    def describe(self) -> str:
        return f"{self.class_path} could not be created in container {self.container}: {self.problem}"


@dataclass(kw_only=True, eq=False)
class CannotMigrate(CallError, RuntimeError):
    """A provider did not move to another container; it continues where it was."""

    provider: str
    to: str
    problem: str
    withdrawn: bool = False
    """Whether it was withdrawn for a moment, which ended its earlier handles."""

    def describe(self) -> str:
        after = "It is offered again where it was, under new handles" if self.withdrawn else "It continues where it was"
        return f"{self.provider} did not move to container {self.to}: {self.problem}. {after}"


@dataclass(kw_only=True, eq=False)
class MigrationUnknown(CallError, ConnectionError):
    """Contact was lost while a provider moved; it is offered in the new place or nowhere, never in both."""

    provider: str
    container: str
    """Where it was."""
    to: str
    withdrawn: str
    """The name with which `System.register` offers it again where it was."""

    def describe(self) -> str:
        remedy = f"`trade call trade.register '\"{self.withdrawn}\"' --container {self.container}`"
        return (
            f"container {self.to} was lost while {self.provider} moved there. It may be alive and offer it. If it has "
            f"ended for good, {remedy} offers it again"
        )


@dataclass(kw_only=True, eq=False)
class InvalidResult(CallError, TypeError):
    """The provider's result does not match its return annotation; a defect of the provider."""

    service: str
    problem: str

    def describe(self) -> str:
        return f"{self.service} ran, but its result does not match its annotation: {self.problem}. Fix the provider"


@dataclass(kw_only=True, eq=False)
class RemoteError(CallError, RuntimeError):
    """The provider raised an exception of a type that this process does not know."""

    service: str
    type_name: str
    message: str
    traceback: str = ""

    def describe(self) -> str:
        return f"{self.service} raised {self.type_name}: {self.message}"


# --- the device


@dataclass(kw_only=True, eq=False)
class DeviceError(TradeError):
    """A device did not carry out a command."""

    device: str
    bus: str


@dataclass(kw_only=True, eq=False)
class DeviceSilent(DeviceError, TimeoutError):
    """A device did not answer in time; its last values are too old to trust."""

    waited_s: float
    """How long it has been silent: since the request, or since its last measurement."""
    reason: str = ""
    """Why, if that is known."""

    def describe(self) -> str:
        if self.reason:
            return f"{self.device} did not answer on {self.bus}{_for(self.waited_s)}: {self.reason}"
        return (
            f"{self.device} did not answer on {self.bus}{_for(self.waited_s)}. Is it powered, plugged in, and set to "
            "the id and baud rate of the robot file? If it is simulated, this computer may be too busy"
        )


@dataclass(kw_only=True, eq=False)
class DeviceFault(DeviceError, RuntimeError):
    """A device reports a fault, or refused a command."""

    fault: str
    remedy: str = "remove the cause, then enable it again"

    def describe(self) -> str:
        return f"{self.device} on {self.bus}: {self.fault}; {self.remedy}"


@dataclass(kw_only=True, eq=False)
class BusGone(DeviceSilent, ConnectionError):
    """The port of a bus is gone: unplugged, down, or off the bus. The driver reopens it when it comes back."""

    def describe(self) -> str:
        why = self.reason or "plug its adapter in again"
        return (
            f"{self.device} cannot be reached: port {self.bus} is gone (for {self.waited_s:.1f} s): {why}. "
            "The driver reconnects by itself and moves nothing"
        )


@dataclass(kw_only=True, eq=False)
class SendQueueFull(BusGone):
    """Frames stay in the send queue of a CAN interface: nothing acknowledges them, or the queue is too short.

    ``reason`` names the queue and what to do. The driver stops the joints of the bus, and opens the bus again.
    """

    def describe(self) -> str:
        return (
            f"{self.device} cannot be reached: no frame can be sent on {self.bus} (since {self.waited_s:.1f} s ago): "
            f"{self.reason}. The driver tries again by itself and moves nothing"
        )


@dataclass(kw_only=True, eq=False)
class NotStopped(DeviceSilent):
    """A required stop failed: no client can lock the device until a person has checked and resumed it.

    ``reason`` says when the stop failed, and why.
    """

    def describe(self) -> str:
        return (
            f"{self.device} on {self.bus} could not be stopped {self.reason}, so no client can lock it. "
            f"Check it, then run `trade resume {self.device}`"
        )


TrajectoryPart = Literal["start", "path", "goal"]
"""The part of a trajectory where a tolerance was exceeded."""


@dataclass(kw_only=True, eq=False)
class ToleranceExceeded(DeviceError, RuntimeError):
    """A joint is farther from its trajectory than its tolerance allows: at the start, on the way, or at the end."""

    what: TrajectoryPart
    error_rad: float
    tolerance_rad: float
    cause: str = ""
    """What slows it by order, if the driver knows that, such as a speed slider."""

    def describe(self) -> str:
        off = f"{self.device} is {abs(self.error_rad):.3g} rad off the {self.what} of its trajectory"
        cause = f"Probably {self.cause}: undo that" if self.cause else "Check whether it is blocked or overloaded"
        remedy = f"It holds. {cause}, give it more time, or allow more"
        if self.what == "start":
            remedy = "Nothing was sent. Begin where it is"
        return f"{off}; {self.tolerance_rad:.3g} rad is allowed. {remedy}"


# --- the set-up


@dataclass(kw_only=True, eq=False)
class SetupError(TradeError):
    """The installation or the configuration must change."""


@dataclass(kw_only=True, eq=False)
class ConfigurationError(SetupError, ValueError):
    """A setting, a file or the installation is wrong; the message says where, and what would be right."""

    problem: str
    where: str = ""

    def describe(self) -> str:
        return f"{self.where}: {self.problem}" if self.where else self.problem


@dataclass(kw_only=True, eq=False)
class WrongDevice(ConfigurationError):
    """The device that answers is not the one in the robot file."""

    problem: str = ""
    key: str
    """The key of the robot file: ``model``, ``firmware``, ``serial_number`` or ``homing_counts``."""
    expected: str
    found: str

    def describe(self) -> str:
        says = self.problem or f"the robot file says {self.expected}, but the device says {self.found}"
        remedy = f"Attach that device, or, if this one has replaced it, correct {self.key} and calibrate it"
        return f"{self.where}.{self.key}: {says}. {remedy}"


@dataclass(kw_only=True, eq=False)
class DeviceAbsent(ConfigurationError):
    """No device answers where the robot file has one: it has no power yet, or is not plugged in. Try again later."""


@dataclass(kw_only=True, eq=False)
class CannotConnect(SetupError, ConnectionError):
    """No container at the endpoint accepts this one."""

    endpoint: str
    reason: str

    def describe(self) -> str:
        return f"no link to {self.endpoint}: {self.reason}"


@dataclass(kw_only=True, eq=False)
class NoContainerFound(SetupError, ConnectionError):
    """No other container was found in the system, or some are missing, so the request has no reliable answer."""

    system: str
    so: str = ""
    """The resulting uncertainty, and what to do."""
    others: bool = False
    """Whether another container was found."""
    silent: Sequence[str] = ()
    """Containers that are present but have not answered."""
    apart: Sequence[str] = ()
    """Endpoints where no container was found, each with the reason."""

    def describe(self) -> str:
        parts = [] if self.others else [f"no other container was found in system {self.system}"]
        parts += [_unanswered(self.apart)] if self.apart else []
        parts += [f"{_some(self.silent)} did not answer"] if self.silent else []
        return "; ".join([*parts, self.so] if self.so else parts)


StartFailure = Literal[
    "unknown host key",
    "changed host key",
    "not let in",
    "refused",
    "timeout",
    "unknown host",
    "no trade there",
    "it did not come up",
    "no answer",
    "not seen",
    "no ssh here",
    "ssh failed",
]
"""Why a container was not started on a host."""


@dataclass(kw_only=True, eq=False)
class CannotStart(SetupError, ConnectionError):
    """No container was started on the host, or it did not join this system."""

    host: str
    container: str
    reason: StartFailure
    output: str
    """The output of ssh, or of the command on the host."""
    remedy: str

    def describe(self) -> str:
        output = f" ({self.output})" if self.output else ""
        return f"container {self.container} was not started on {self.host}: {self.reason}{output}; {self.remedy}"


@dataclass(kw_only=True, eq=False)
class LinkStays(SetupError, RuntimeError):
    """The transport cannot cut a link while both of its containers run."""

    to: str

    def describe(self) -> str:
        return (
            f"the link to {self.to} stays while both containers run, but is not dialled again. To cut it, close one "
            "of them, or give them different credentials and restart it"
        )
