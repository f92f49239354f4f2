"""The default container of the process, and functions that use it.

The container that created an object of the process (`System.instantiate`) is the default one, unless there is one.
"""

import contextlib
import functools
import inspect
import signal
import threading
from collections.abc import Callable, Coroutine, Generator
from types import FrameType
from typing import Any, Concatenate, ParamSpec, TypeVar

from trade._container.container import Container
from trade._migration.factory import first_host
from trade._settings import Settings
from trade.errors import ConfigurationError

_P = ParamSpec("_P")
_R = TypeVar("_R")

_LOOK_S = 0.2

_lock = threading.RLock()
_default: Container | None = None
_is_host = False
"""Whether the default container hosts objects of others, and is closed by the program that started it."""


def start(settings: Settings | None = None) -> Container:
    """Starts the default container with the given settings.

    Raises:
        errors.ConfigurationError: it runs already; start it before any other use of ``trade``.
    """
    global _default, _is_host
    with _lock:
        if _default is not None and not _default.closed:
            problem = (
                "the default container runs already. Call trade.start before anything else, or trade.close() first"
            )
            raise ConfigurationError(problem=problem)
        _default, _is_host = Container(settings), False
        return _default


def container() -> Container:
    """The default container; starts it if necessary.

    In a process whose container hosts created objects, such as `trade container`, it is that container.
    """
    global _default, _is_host
    running = _default
    if running is not None and not running.closed:
        return running
    with _lock:
        host = first_host()
        if isinstance(host, Container) and (_default is None or _default.closed):
            _default, _is_host = host, True
        return _default if _default is not None else start()


def close() -> None:
    """Closes the default container, which leaves the system. The next use starts a new one. Idempotent.

    An object does not close the container that hosts it: other objects are there, too.
    """
    global _default, _is_host
    with _lock:
        if _is_host and _default is not None and not _default.closed:
            return
        running, _default, _is_host = _default, None, False
    if running is not None:
        running.close()


def serve() -> None:
    """Keeps the default container in the system until Ctrl-C, SIGTERM, or its end from elsewhere; then closes it.

    For the end of a script that offers services. Starts the container if necessary.
    """
    running = container()
    try:
        with _ended_by_sigterm():
            while not running.closed:
                threading.Event().wait(_LOOK_S)
    except KeyboardInterrupt:
        pass
    close()


@contextlib.contextmanager
def _ended_by_sigterm() -> Generator[None]:
    """Turns SIGTERM into KeyboardInterrupt. Only the main thread of a process may do so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def of_default(method: Callable[Concatenate[Container, _P], _R]) -> Callable[_P, _R]:
    """A method of `Container` as a function of ``trade`` on the default container."""

    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        return method(container(), *args, **kwargs)

    return _presented(call, method)


def aof_default(
    method: Callable[Concatenate[Container, _P], Coroutine[Any, Any, _R]],
) -> Callable[_P, Coroutine[Any, Any, _R]]:
    """The same of a coroutine function."""

    async def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        return await method(container(), *args, **kwargs)

    return _presented(call, method)


def _presented(call: Callable[_P, _R], method: Callable[..., object]) -> Callable[_P, _R]:
    """Gives a function of ``trade`` the name, signature and docstring of a method."""
    functools.update_wrapper(call, method)
    own = inspect.signature(method)
    call.__signature__ = own.replace(parameters=list(own.parameters.values())[1:])
    call.__module__, call.__qualname__ = "trade", method.__name__
    return call
