"""The error tree: one root, branches by who must act.

Every error carries its data as attributes, crosses the wire with them, and says what to do next. Each also inherits the
builtin a Python programmer would catch for it, so ``except TimeoutError`` finds a deadline that passed.

One module on purpose, however long: whoever catches reads the tree as a whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

from trade._timestamps import clock

__all__ = [
    "AccessDenied",
    "BusGone",
    "Busy",
    "CallError",
    "CallerError",
    "Cancelled",
    "CannotConnect",
    "CannotInstantiate",
    "CannotMigrate",
    "CannotStart",
    "ConfigurationError",
    "ContainerLost",
    "DeadlineExceeded",
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
    "NoSuchCall",
    "NoSuchClass",
    "NoSuchEstop",
    "NoSuchHook",
    "NoSuchNotification",
    "NoSuchService",
    "NobodyFound",
    "NotInstantiable",
    "NotLocked",
    "NotSerialisable",
    "NotStopped",
    "OutcomeUnknown",
    "RemoteError",
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


_WORTH_TELLING_S: Final = 0.1
"""A shorter silence than this is one exchange of a bus: its length says nothing."""
_NO_MORE_TENTHS_S: Final = 10.0


@dataclass(kw_only=True, eq=False)
class TradeError(Exception):
    """Root of everything this project raises on purpose."""

    def __str__(self) -> str:
        return self.describe()

    def describe(self) -> str:
        """The message: what happened, then what to do."""
        return type(self).__name__

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), {f.name: getattr(self, f.name) for f in fields(self)})


def _rebuild(cls: type[TradeError], data: dict[str, object]) -> TradeError:
    return cls(**data)


def _some(texts: Sequence[str]) -> str:
    """The first five."""
    return ", ".join(list(texts)[:5]) + (", ..." if len(texts) > 5 else "")


def _nobody_at(apart: Sequence[str]) -> str:
    """At which endpoints nobody was found, and why."""
    return "; ".join(f"nobody answers at {endpoint}" for endpoint in apart)


def _for(seconds: float) -> str:
    """How long something has lasted, if that is worth telling."""
    if seconds < _WORTH_TELLING_S:
        return ""
    return f" for {seconds:.1f} s" if seconds < _NO_MORE_TENTHS_S else f" for {seconds:.0f} s"


# --- the caller must act


@dataclass(kw_only=True, eq=False)
class CallerError(TradeError):
    """The caller asked for something that cannot be given."""


@dataclass(kw_only=True, eq=False)
class NoSuchService(CallerError, LookupError):
    """Nothing in the system matches the constraint."""

    constraint: str
    waited_s: float = 0.0
    near: Sequence[str] = ()
    groups: Sequence[str] = ()
    """Some of those there are in the system."""
    apart: Sequence[str] = ()
    """Endpoints where nobody was found, each with the reason, if nobody else was found at all."""
    hidden: str = ""
    """Why it would not be seen here if it was there, in words of the policy; empty: it would."""

    def describe(self) -> str:
        return f"no service matches {self.constraint} after {self.waited_s:.3g} s; {self._hint()}"

    def _hint(self) -> str:
        if self.hidden:
            return f"{self.hidden}; so nothing of it is seen here, and whoever keeps the policy can change that"
        if self.near:
            return f"did you mean {' or '.join(self.near)}?"
        if self.groups:
            return f"there is {_some(self.groups)}; `trade services` lists what they offer"
        if self.apart:
            return _nobody_at(self.apart)
        return "nothing is offered in this system: is its provider up, with the same TRADE_SYSTEM?"


@dataclass(kw_only=True, eq=False)
class TooManyServices(CallerError, LookupError):
    """More than one service matches where exactly one was wanted."""

    constraint: str
    matches: Sequence[str]
    differ: Sequence[str] = ()
    """Keywords of ``where`` that tell some of them apart."""

    def describe(self) -> str:
        if self.differ:
            remedy = f"add a constraint on what tells them apart ({', '.join(self.differ)})"
        else:
            remedy = "nothing that can be asked for tells them apart: register them in groups or with meta of their own"
        found = f"{len(self.matches)} services match {self.constraint}: {_some(self.matches)}"
        return f"{found}; {remedy}, or take them all with trade.services(...)"


@dataclass(kw_only=True, eq=False)
class ServiceGone(CallerError, LookupError):
    """The service behind this handle was deregistered, or its container has ended or restarted."""

    service: str
    reason: str = "its provider was deregistered"
    moved_to: str = ""
    """Where its provider goes on, if it moved: ``identity/container/epoch/domain/provider``. Handles do not follow."""

    def describe(self) -> str:
        return f"{self.service} is gone: {self.reason}; look it up again with trade.find(...)"


@dataclass(kw_only=True, eq=False)
class InvalidArgument(CallerError, ValueError, TypeError):
    """An argument does not fit the service's signature; no code of the provider ran."""

    service: str
    argument: str
    problem: str
    signature: str = ""

    def describe(self) -> str:
        where = f" argument {self.argument!r}" if self.argument else ""
        tail = f"; it is called as {self.signature}" if self.signature else ""
        return f"{self.service}{where}: {self.problem}{tail}"


@dataclass(kw_only=True, eq=False)
class LimitExceeded(CallerError, ValueError):
    """A commanded value lies outside a configured limit; it was refused, not clipped."""

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
    """A value cannot be sent: it is no plain data, struct, dataclass, enum or handle."""

    service: str
    what: str
    problem: str

    def describe(self) -> str:
        return f"{self.service}: {self.what} cannot be sent: {self.problem}; use plain data, a struct or a handle"


@dataclass(kw_only=True, eq=False)
class TooLarge(CallerError, ValueError):
    """Arguments or a result are larger than a message may be; not a byte of them was sent."""

    service: str
    what: str
    size_bytes: int
    limit_bytes: int

    def describe(self) -> str:
        size, limit = self.size_bytes / (1 << 20), self.limit_bytes / (1 << 20)
        return (
            f"{self.service}: {self.what} of {size:.1f} MiB ({self.size_bytes} bytes) cannot be sent, the limit is "
            f"{limit:.0f} MiB; send it in parts"
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
            f"no answer from {self.service} within {self.deadline_s:.3g} s; whether it ran is unknown. Look at its "
            "state before trying again; handle.with_(deadline_s=...) waits longer"
        )


@dataclass(kw_only=True, eq=False)
class MotionStopped(CallerError, RuntimeError):
    """A motion ended before its goal because somebody wanted it to; the joint holds where it stopped."""

    device: str
    reason: str

    def describe(self) -> str:
        return f"{self.device} stopped before its goal: {self.reason}. It holds its position"


@dataclass(kw_only=True, eq=False)
class Stopped(CallerError, RuntimeError):
    """A stop by somebody else holds until it is resumed; nothing moves before that."""

    resource: str
    by: str
    reason: str
    estop: bool = False
    """Whether an e-stop is open."""
    cleared: bool = False
    """Whether an e-stop did it that is cleared by now: what it stopped waits for who resumes it."""

    def describe(self) -> str:
        remedy = "`trade estop --clear`" if self.estop else f"trade.resume(...) or `trade resume {self.resource}`"
        cleared = " That e-stop is cleared, and nobody has resumed what it stopped." if self.cleared else ""
        said = f"{self.resource} was stopped by {self.by}: {self.reason}.{cleared}"
        return f"{said} When it is safe to move, call {remedy}"


@dataclass(kw_only=True, eq=False)
class NoSuchEstop(CallerError, LookupError):
    """Nobody in the system knows an e-stop of that id as open; nothing was cleared."""

    ids: Sequence[str]
    open: Sequence[str]
    """Those that are."""

    def describe(self) -> str:
        there = f"open {'is' if len(self.open) == 1 else 'are'} {_some(self.open)}" if self.open else "none is open"
        return f"there is no open e-stop {', '.join(self.ids)}; {there}"


@dataclass(kw_only=True, eq=False)
class NoSuchNotification(CallerError, LookupError):
    """No notification of that id stands anywhere that is known here."""

    id: str

    def describe(self) -> str:
        return f"there is no notification {self.id}: it has ended, or was cancelled; `trade notifications` lists them"


@dataclass(kw_only=True, eq=False)
class NoSuchHook(CallerError, LookupError):
    """No hook of that id is attached anywhere that is known here."""

    id: str

    def describe(self) -> str:
        return f"there is no hook {self.id}: it was detached, or who attached it has ended; `trade hooks` lists them"


@dataclass(kw_only=True, eq=False)
class NoSuchCall(CallerError, LookupError):
    """No container has noted a call of that id."""

    id: int

    def describe(self) -> str:
        return (
            f"no container has noted a call {self.id}: none that it touched is traced (`trade tracing on`), it has not "
            "ended, or newer calls took its place"
        )


@dataclass(kw_only=True, eq=False)
class NotInstantiable(CallerError, PermissionError):
    """The settings of the container do not allow to make objects of that class; nothing was imported."""

    class_path: str
    container: str
    allowed: Sequence[str] = ()

    def describe(self) -> str:
        allowed = f"only {_some(self.allowed)}" if self.allowed else "none at all"
        return (
            f"container {self.container} may not make a {self.class_path}: it allows {allowed}; start it with "
            f"`trade container --allow {self.class_path}`, or TRADE_INSTANTIABLE"
        )


@dataclass(kw_only=True, eq=False)
class NoSuchClass(CallerError, LookupError):
    """The container's Python has no class of that path."""

    class_path: str
    container: str
    reason: str

    def describe(self) -> str:
        return (
            f"there is no class {self.class_path} in container {self.container}: {self.reason}; is its package "
            "installed there, and is it package.module:Class?"
        )


@dataclass(kw_only=True, eq=False)
class AccessDenied(CallerError, PermissionError):
    """The access policy does not allow it; nothing was done."""

    who: str
    """The identity that asked."""
    verb: str
    what: str
    """The group, or the service."""
    rule: str
    """Why, in words of the policy."""

    def describe(self) -> str:
        return (
            f"{self.who} may not {self.verb} {self.what}: {self.rule}; "
            "`trade policy show` tells who may what, and whoever keeps the policy can change it"
        )


@dataclass(kw_only=True, eq=False)
class LockedByOther(CallerError, PermissionError):
    """Somebody else has it for themselves."""

    resources: Sequence[str]
    owner: str
    purpose: str = ""
    since: float = 0.0
    """Seconds since the epoch, by the clock of the container that granted it."""
    own: bool = False
    """The owner is this very container, in another thread or task."""

    def describe(self) -> str:
        what = ", ".join(self.resources)
        aim = f" for {self.purpose!r}" if self.purpose else ""
        when = f" since {clock(self.since)}" if self.since else ""
        if self.own:
            hint = "that is this container itself: make the call inside `with lock.use():`"
        else:
            hint = "wait with trade.lock(..., wait_s=...) or ask with trade.request_release(...)"
        return f"{what} is locked by {self.owner}{aim}{when}; {hint}"


@dataclass(kw_only=True, eq=False)
class InUse(CallerError, PermissionError):
    """A container was to end only if nothing of it is locked and nothing moves; nothing was done."""

    container: str
    uses: Sequence[str]

    def describe(self) -> str:
        return f"container {self.container} is in use: {'; '.join(self.uses)}; wait, or ask its user to let go"


@dataclass(kw_only=True, eq=False)
class LockLost(CallerError, ConnectionError):
    """A lock one had holds no more; nothing was done under it, and what moved under it was told to stop."""

    resources: Sequence[str]
    reason: str

    def describe(self) -> str:
        return f"the lock of {', '.join(self.resources)} is lost: {self.reason}; take it anew with trade.lock(...)"


@dataclass(kw_only=True, eq=False)
class SessionEnded(CallerError, ConnectionError):
    """Whoever asks is not there any more: nothing was done, and what he had set moving was told to stop."""

    session: str
    reason: str

    def describe(self) -> str:
        return f"session {self.session} has ended: {self.reason}; open another one with trade.open_session(...)"


@dataclass(kw_only=True, eq=False)
class IncompleteGroup(CallerError, LookupError):
    """Members of a robot's group, or alternatives of a constraint, are not there: no lock over the whole of it."""

    group: str
    missing: Sequence[str]

    def describe(self) -> str:
        return (
            f"{self.group} is not complete: {', '.join(self.missing)} missing; start what drives it, or lock what is "
            "there with partial=True"
        )


@dataclass(kw_only=True, eq=False)
class NotLocked(CallerError, PermissionError):
    """The lock around a command selects the service and does not hold it; nothing was sent."""

    service: str
    selected_by: str
    """The constraint of the lock."""

    def describe(self) -> str:
        return (
            f"{self.service} is selected by the lock of {self.selected_by}, which does not hold it: it was not there "
            "when the lock was taken. Give it back and take the lock again"
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
    """The far side of a call failed."""


@dataclass(kw_only=True, eq=False)
class ContainerLost(CallError, ConnectionError):
    """The container ended or became unreachable while the call was under way; whether it ran is unknown."""

    service: str
    container: str

    def describe(self) -> str:
        return (
            f"container {self.container} was lost during a call of {self.service}; whether it ran is unknown. "
            "Find the service again and look at its state"
        )


@dataclass(kw_only=True, eq=False)
class SourceLost(ContainerLost):
    """The container whose service is listened to ended or became unreachable."""

    def describe(self) -> str:
        return (
            f"container {self.container} was lost while {self.service} was listened to; samples come again when it is "
            "back. If it was restarted, find the service again and open another stream"
        )


@dataclass(kw_only=True, eq=False)
class Busy(CallError, BlockingIOError):
    """All handler threads of the container are taken; nothing ran."""

    service: str
    container: str

    def describe(self) -> str:
        return f"{self.service} did not run: container {self.container} has no free handler thread; try again shortly"


@dataclass(kw_only=True, eq=False)
class CannotInstantiate(CallError, RuntimeError):
    """The class raised when it was imported or made; nothing was registered."""

    class_path: str
    container: str
    problem: str

    def describe(self) -> str:
        return f"{self.class_path} could not be made in container {self.container}: {self.problem}"


@dataclass(kw_only=True, eq=False)
class CannotMigrate(CallError, RuntimeError):
    """A provider did not move to another container; it goes on where it was."""

    provider: str
    to: str
    problem: str
    withdrawn: bool = False
    """It was withdrawn for a moment: handles from before are dead."""

    def describe(self) -> str:
        after = "it is offered again where it was, under new handles" if self.withdrawn else "it goes on where it was"
        return f"{self.provider} did not move to container {self.to}: {self.problem}; {after}"


@dataclass(kw_only=True, eq=False)
class MigrationUnknown(CallError, ConnectionError):
    """Contact was lost at the moment a provider moved; it is offered there, or nowhere, and never twice."""

    provider: str
    container: str
    """Where it was."""
    to: str
    withdrawn: str
    """The name by which `System.register` offers it again where it was."""

    def describe(self) -> str:
        remedy = f"`trade call trade.register '\"{self.withdrawn}\"' --container {self.container}`"
        return (
            f"container {self.to} was lost when {self.provider} moved there: it may be alive and offer it. If it has "
            f"ended for good, {remedy} offers it again"
        )


@dataclass(kw_only=True, eq=False)
class InvalidResult(CallError, TypeError):
    """The provider returned something else than its annotation says; a defect of the provider."""

    service: str
    problem: str

    def describe(self) -> str:
        return f"{self.service} ran, but its result breaks its own annotation: {self.problem}; mend the provider"


@dataclass(kw_only=True, eq=False)
class RemoteError(CallError, RuntimeError):
    """The provider raised an exception of a type this process does not know."""

    service: str
    type_name: str
    message: str
    traceback: str = ""

    def describe(self) -> str:
        return f"{self.service} raised {self.type_name}: {self.message}"


# --- the device


@dataclass(kw_only=True, eq=False)
class DeviceError(TradeError):
    """A device did not do what it was told."""

    device: str
    bus: str


@dataclass(kw_only=True, eq=False)
class DeviceSilent(DeviceError, TimeoutError):
    """A device has not answered within its time; the last values are too old to be trusted."""

    waited_s: float
    """How long it has not: since it was asked, or since it was last measured."""

    def describe(self) -> str:
        return (
            f"{self.device} did not answer on {self.bus}{_for(self.waited_s)}; is it powered, plugged in, and set to "
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
    """The port of a bus is gone: unplugged, down, or off the bus. It is opened again by itself when it comes back."""

    reason: str = ""
    """What its system or its adapter says."""

    def describe(self) -> str:
        why = self.reason or "plug its adapter in again"
        return (
            f"{self.device} cannot be reached: port {self.bus} is gone (for {self.waited_s:.1f} s): {why}. "
            "The driver reconnects by itself and moves nothing"
        )


@dataclass(kw_only=True, eq=False)
class NotStopped(DeviceSilent):
    """It could not be stopped when it had to be: nobody gets a lock on it before somebody has looked and resumes it."""

    reason: str
    """Why, and when that was."""

    def describe(self) -> str:
        return (
            f"{self.device} on {self.bus}: could not be stopped {self.reason}, so nobody gets a lock on it; "
            f"look at it, then `trade resume {self.device}`"
        )


@dataclass(kw_only=True, eq=False)
class ToleranceExceeded(DeviceError, RuntimeError):
    """A joint is farther from its trajectory than it may be: where it begins, on the way, or where it ends."""

    what: str
    """``start``, ``path`` or ``goal``."""
    error_rad: float
    tolerance_rad: float

    def describe(self) -> str:
        off = f"{self.device} is {abs(self.error_rad):.3g} rad off the {self.what} of its trajectory"
        remedy = "it holds; look whether it is blocked or overloaded, give it more time, or allow more"
        if self.what == "start":
            remedy = "nothing was sent; begin where it is"
        return f"{off}, {self.tolerance_rad:.3g} is allowed: {remedy}"


# --- the set-up


@dataclass(kw_only=True, eq=False)
class SetupError(TradeError):
    """Something about the installation or configuration must be changed."""


@dataclass(kw_only=True, eq=False)
class ConfigurationError(SetupError, ValueError):
    """A setting, file or installation is wrong; the message says where and what would be right."""

    problem: str
    where: str = ""

    def describe(self) -> str:
        return f"{self.where}: {self.problem}" if self.where else self.problem


@dataclass(kw_only=True, eq=False)
class WrongDevice(ConfigurationError):
    """A device answers that is not the one the robot file means."""

    problem: str = ""
    key: str
    """Of the robot file: ``model``, ``firmware``, ``serial_number`` or ``homing_counts``."""
    expected: str
    found: str

    def describe(self) -> str:
        says = self.problem or f"the robot file says {self.expected}, but the device says {self.found}"
        remedy = f"attach that one, or correct {self.key} if this one has taken its place, and calibrate it"
        return f"{self.where}.{self.key}: {says}; {remedy}"


@dataclass(kw_only=True, eq=False)
class CannotConnect(SetupError, ConnectionError):
    """Nobody at the endpoint lets this container in."""

    endpoint: str
    reason: str

    def describe(self) -> str:
        return f"no link to {self.endpoint}: {self.reason}"


@dataclass(kw_only=True, eq=False)
class NobodyFound(SetupError, ConnectionError):
    """Nobody else was found in the system, or not all of it: what was asked cannot be told."""

    system: str
    so: str = ""
    """What cannot be told therefore, and what to do."""
    others: bool = False
    """Whether somebody was found."""
    silent: Sequence[str] = ()
    """Containers that are there, and have not answered."""
    apart: Sequence[str] = ()
    """Endpoints where nobody was found, each with the reason."""

    def describe(self) -> str:
        said = [] if self.others else [f"nobody was found in system {self.system}"]
        said += [_nobody_at(self.apart)] if self.apart else []
        said += [f"{_some(self.silent)} did not answer"] if self.silent else []
        return "; ".join([*said, self.so] if self.so else said)


@dataclass(kw_only=True, eq=False)
class CannotStart(SetupError, ConnectionError):
    """No container was started on the host, or it does not come into this system."""

    host: str
    container: str
    reason: str
    """``unknown host key``, ``changed host key``, ``not let in``, ``refused``, ``timeout``, ``unknown host``,
    ``no trade there``, ``it did not come up``, ``no answer``, ``not seen``, ``no ssh here`` or ``ssh failed``."""
    said: str
    """By ssh, or by the command there."""
    remedy: str

    def describe(self) -> str:
        said = f" ({self.said})" if self.said else ""
        return f"container {self.container} was not started on {self.host}: {self.reason}{said}; {self.remedy}"


@dataclass(kw_only=True, eq=False)
class LinkStays(SetupError, RuntimeError):
    """A link cannot be cut while both of its containers run; the transport has no way to."""

    to: str

    def describe(self) -> str:
        return (
            f"the link to {self.to} stays while both containers run; it is dialled no more. To cut it, close one of "
            "them, or give them different credentials and restart it"
        )
