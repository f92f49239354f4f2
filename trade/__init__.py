"""TRADE: a service middleware for robots.

The ``@service`` methods of any object become callable from anywhere in the system, and clients find services by their
properties. The functions here use the process's default container, which starts on first use.
"""

from typing import Any as _Any
from typing import cast as _cast

from msgspec import Meta

from trade import errors
from trade import records as _records
from trade._calls.batch import Outcome
from trade._calls.find_types import Acall as _Acall
from trade._calls.find_types import Afind as _Afind
from trade._calls.find_types import Find as _Find
from trade._calls.find_types import FindRobot as _FindRobot
from trade._calls.group_view import GroupView
from trade._calls.handle import BoundCall, Handle, handle_of, start_call
from trade._calls.reachability import Reachability
from trade._calls.run import Run
from trade._container.container import Container
from trade._container.default import aof_default as _aof_default
from trade._container.default import close, container, serve, start
from trade._container.default import of_default as _of_default
from trade._container.system import System
from trade._context.call_context import CallContext, current_call, progress
from trade._context.sessions import Session
from trade._counters import Measure
from trade._discovery.link_table import LinkInfo, NetworkInfo
from trade._estop.broadcast import EstopReport
from trade._hooks.api import Hook
from trade._hooks.guard import Guard
from trade._hooks.hook import HookEvent, HookInfo
from trade._locks.lock import Lock
from trade._notifications.events import StateEvent
from trade._notifications.notification import Notification, NotificationInfo
from trade._registry.constraints import Constraint, where
from trade._resources.grants import LockInfo, StopInfo
from trade._resources.resource import Permit, Resource, permit
from trade._services.decorator import effect_of, service
from trade._services.secret import Secret
from trade._settings import Settings
from trade._streams.source import ListenerInfo
from trade._streams.stream import Stream
from trade._table import Table
from trade._telemetry.load import LoadInfo
from trade._telemetry.log_buffer import LogLine
from trade._telemetry.spans import Span
from trade._tracing.api import LogReader, Trace
from trade.call_model import CallDeviation, CallModel, CallProfile
from trade.pddl import pddl_domain
from trade.protocol.container_info import ContainerInfo
from trade.protocol.messages import Estop
from trade.protocol.samples import Sample
from trade.protocol.schema_types import publish as _publish
from trade.stop_line import StopReport

__all__ = [
    "BoundCall",
    "CallContext",
    "CallDeviation",
    "CallModel",
    "CallProfile",
    "Constraint",
    "Container",
    "ContainerInfo",
    "Estop",
    "EstopReport",
    "GroupView",
    "Guard",
    "Handle",
    "Hook",
    "HookEvent",
    "HookInfo",
    "LinkInfo",
    "ListenerInfo",
    "LoadInfo",
    "Lock",
    "LockInfo",
    "LogLine",
    "LogReader",
    "Measure",
    "Meta",
    "NetworkInfo",
    "Notification",
    "NotificationInfo",
    "Outcome",
    "Permit",
    "Reachability",
    "Resource",
    "Run",
    "Sample",
    "Secret",
    "Session",
    "Settings",
    "Span",
    "StateEvent",
    "StopInfo",
    "StopReport",
    "Stream",
    "System",
    "Table",
    "Trace",
    "acall",
    "acall_all",
    "acall_sequence",
    "add_group",
    "aestop",
    "afind",
    "after",
    "after_service",
    "alocks",
    "alter",
    "aresume",
    "astop",
    "astream",
    "at",
    "before_service",
    "break_lock",
    "call",
    "call_all",
    "call_sequence",
    "cancel_notification",
    "changed",
    "close",
    "container",
    "containers",
    "current_call",
    "deregister",
    "detach_hook",
    "effect_of",
    "errors",
    "estop",
    "estop_clear",
    "estops",
    "every",
    "find",
    "guard",
    "guards",
    "handle_of",
    "hooks",
    "joined",
    "left",
    "lock",
    "locks",
    "logs",
    "migrate",
    "notifications",
    "occurred",
    "once",
    "open_session",
    "pddl_domain",
    "permit",
    "progress",
    "register",
    "remove_group",
    "request_release",
    "restore_state",
    "resume",
    "robot",
    "save_state",
    "serve",
    "service",
    "services",
    "set_groups",
    "set_health",
    "set_tracing",
    "spans",
    "start",
    "start_call",
    "stop",
    "stream",
    "system",
    "trace",
    "where",
]

system = System(lambda: container()._parts)
"""The settings and controls of the default container."""


register = _of_default(Container.register)
deregister = _of_default(Container.deregister)
set_groups = _of_default(Container.set_groups)
add_group = _of_default(Container.add_group)
remove_group = _of_default(Container.remove_group)
set_health = _of_default(Container.set_health)
alter = _of_default(Container.alter)
migrate = _of_default(Container.migrate)
save_state = _of_default(Container.save_state)
restore_state = _of_default(Container.restore_state)
services = _of_default(Container.services)
find: _Find = _cast("_Find", _of_default(_cast("_Any", Container.find)))
robot: _FindRobot = _cast("_FindRobot", _of_default(_cast("_Any", Container.robot)))
call = _of_default(Container.call)
call_all = _of_default(Container.call_all)
call_sequence = _of_default(Container.call_sequence)
afind: _Afind = _cast("_Afind", _aof_default(_cast("_Any", Container.afind)))
acall: _Acall = _cast("_Acall", _aof_default(_cast("_Any", Container.acall)))
acall_all = _aof_default(Container.acall_all)
acall_sequence = _aof_default(Container.acall_sequence)
containers = _of_default(Container.containers)
joined = _of_default(Container.joined)
left = _of_default(Container.left)
changed = _of_default(Container.changed)
occurred = _of_default(Container.occurred)
once = _of_default(Container.once)
after = _of_default(Container.after)
at = _of_default(Container.at)
every = _of_default(Container.every)
notifications = _of_default(Container.notifications)
cancel_notification = _of_default(Container.cancel_notification)
before_service = _of_default(Container.before_service)
after_service = _of_default(Container.after_service)
guard = _of_default(Container.guard)
guards = _of_default(Container.guards)
hooks = _of_default(Container.hooks)
detach_hook = _of_default(Container.detach_hook)
set_tracing = _of_default(Container.set_tracing)
spans = _of_default(Container.spans)
trace = _of_default(Container.trace)
logs = _of_default(Container.logs)
stream = _of_default(Container.stream)
astream = _aof_default(Container.astream)
astop = _aof_default(Container.astop)
aestop = _aof_default(Container.aestop)
aresume = _aof_default(Container.aresume)
alocks = _aof_default(Container.alocks)
lock = _of_default(Container.lock)
locks = _of_default(Container.locks)
request_release = _of_default(Container.request_release)
break_lock = _of_default(Container.break_lock)
resume = _of_default(Container.resume)
stop = _of_default(Container.stop)
estop = _of_default(Container.estop)
open_session = _of_default(Container.open_session)
estops = _of_default(Container.estops)
estop_clear = _of_default(Container.estop_clear)

_publish(
    __name__,
    CallDeviation,
    CallModel,
    CallProfile,
    ContainerInfo,
    Estop,
    EstopReport,
    Handle,
    HookInfo,
    LinkInfo,
    ListenerInfo,
    LoadInfo,
    LockInfo,
    LogLine,
    NetworkInfo,
    NotificationInfo,
    Span,
    StateEvent,
    StopInfo,
)
_publish(_records.__name__, *(getattr(_records, _name) for _name in _records.__all__))


def __getattr__(name: str) -> str:
    """``trade.__version__``, read only when it is asked for."""
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415 - it imports the parser of e-mails

        return version("trade-core")
    raise AttributeError(f"module 'trade' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, for shells that complete them."""
    return [*__all__, "__version__"]
