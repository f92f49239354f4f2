"""TRADE: a service middleware for robots.

Any object's ``@service`` methods become callable from anywhere in the system; services are found by what they are. The
functions here use the process's default container, which starts itself on first use.
"""

import threading
from collections.abc import Sequence

from msgspec import Meta

from trade import errors
from trade._constraints import Constraint, where
from trade._container import Container
from trade._context import CallContext, current_call, progress
from trade._handle import Handle, Run
from trade._notifications import Callback, Notification
from trade._secret import Secret
from trade._service import service
from trade._settings import Settings
from trade._system import ContainerInfo

__all__ = [
    "CallContext",
    "Constraint",
    "Container",
    "ContainerInfo",
    "Handle",
    "Meta",
    "Notification",
    "Run",
    "Secret",
    "Settings",
    "close",
    "container",
    "containers",
    "current_call",
    "deregister",
    "errors",
    "find",
    "joined",
    "left",
    "progress",
    "register",
    "service",
    "services",
    "start",
    "where",
]

_lock = threading.RLock()
_default: Container | None = None


def start(settings: Settings | None = None) -> Container:
    """Start the default container with settings of one's own.

    Raises:
        errors.ConfigurationError: it runs already; start it before the first other use of ``trade``.
    """
    global _default  # noqa: PLW0603 - the one default
    with _lock:
        if _default is not None:
            problem = (
                "the default container runs already; call trade.start before anything else, or trade.close() first"
            )
            raise errors.ConfigurationError(problem=problem)
        _default = Container(settings)
        return _default


def container() -> Container:
    """The default container, started if need be."""
    running = _default
    if running is not None:
        return running
    with _lock:
        return _default if _default is not None else start()


def close() -> None:
    """Leave the system: close the default container. The next use starts a new one. Idempotent."""
    global _default
    with _lock:
        running, _default = _default, None
    if running is not None:
        running.close()


def register(
    provider: object, groups: str | Sequence[str] = (), *, implements: Sequence[type] = ()
) -> tuple[Handle, ...]:
    """Offer an object's services to the whole system; see `Container.register`."""
    return container().register(provider, groups, implements=implements)


def deregister(provider: object) -> None:
    """Withdraw an object's services from the whole system; see `Container.deregister`."""
    container().deregister(provider)


def services(constraint: Constraint | None = None) -> list[Handle]:
    """Handles of all services that match; see `Container.services`."""
    return container().services(constraint)


def find(constraint: Constraint, *, wait_s: float = 2.0) -> Handle:
    """The only service that matches; see `Container.find`."""
    return container().find(constraint, wait_s=wait_s)


def containers() -> list[ContainerInfo]:
    """The containers of the system, this one included."""
    return container().containers()


def joined(constraint: Constraint, call: Callback, *, existing: bool = False) -> Notification:
    """Call with the handle of every service that comes and matches; see `Container.joined`."""
    return container().joined(constraint, call, existing=existing)


def left(constraint: Constraint, call: Callback) -> Notification:
    """Call with the handle of every service that goes and matched; see `Container.left`."""
    return container().left(constraint, call)
