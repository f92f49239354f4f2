"""Puts stand-ins in place of `threading`, `time` and their like in modules, and takes them out again."""

import asyncio.base_events
import asyncio.selector_events
import concurrent.futures._base
import concurrent.futures.thread
import contextlib
import http.client
import importlib
import importlib.util
import logging
import queue
import random
import secrets
import socket
import sys
import threading
import time
import types
import uuid
from collections.abc import Callable, Generator, Iterable, Mapping
from types import ModuleType
from typing import Any, Final, NamedTuple, cast

from trade.testing.virtual import _descriptors, _sockets, _threads
from trade.testing.virtual._descriptors import Descriptors
from trade.testing.virtual._scheduler import Scheduler, VirtualTimeError

PACKAGES: Final = (
    "trade",
    "trade_checks",
    "trade_drivers",
    "trade_gateway",
    "trade_hil_sim",
    "pytest_trade_hil_sim",
    "can",
    "canopen",
    "dynamixel_sdk",
    "pymodbus",
    "anyio",
    "starlette",
    "uvicorn",
    "websockets",
)
"""The packages whose modules live on virtual time, beside those that a test names."""
_STANDARD: Final = (
    asyncio.base_events,
    asyncio.selector_events,
    concurrent.futures._base,
    concurrent.futures.thread,
    http.client,
    logging,
)
"""Modules of the standard library that wait, or hold a lock while other code runs."""
_OWN: Final = "trade.testing.virtual"
_LOCK: Final = type(threading.Lock())
_RLOCK: Final = type(threading.RLock())


class Replacements:
    """The stand-ins, by the identity of what they replace."""

    def __init__(self, scheduler: Scheduler, files: Descriptors) -> None:
        self._of: dict[int, Any] = {}
        self._keep: list[Any] = []
        threads = self._module(threading, _threads.stand_ins(scheduler))
        clocks = self._module(time, _clocks(scheduler))
        queues = _queues(threads, clocks)
        self._put(queue, queues)
        self._put(queue.SimpleQueue, queues.SimpleQueue)
        self._put(queue.Queue, queues.Queue)
        self._module(secrets, _ids(scheduler))
        self._module(uuid, {"uuid4": lambda: uuid.UUID(int=scheduler.numbers.getrandbits(128), version=4)})
        self._module(random, _drawn(scheduler))
        for module, names in _descriptors.stand_ins(files).items():
            self._module(module, names)
        self._module(socket, _sockets.stand_ins(scheduler, files))
        for name, used in _REFUSED.items():
            module = importlib.import_module(name)
            self._module(module, {each: _refused(getattr(module, each), f"{name}.{each}") for each in used})
        self._lock, self._rlock = threads.Lock, threads.RLock

    def _put(self, real: Any, stand_in: Any) -> None:
        self._keep.append(real)  # its identity is not given to another object
        self._of[id(real)] = stand_in

    def _module(self, module: ModuleType, names: Mapping[str, Any]) -> ModuleType:
        """A copy of a module with other names, which are replaced where they were imported, too."""
        copy = types.ModuleType(module.__name__, module.__doc__)
        copy.__dict__.update(module.__dict__)
        copy.__dict__.update(names)
        self._put(module, copy)
        for name, stand_in in names.items():
            if hasattr(module, name):
                self._put(getattr(module, name), stand_in)
        return copy

    def get(self, value: Any) -> Any:
        """The stand-in for a value, or None. That for a lock is a free one."""
        found = self._of.get(id(value))
        if found is None and type(value) is _LOCK:
            return self._lock()
        if found is None and type(value) is _RLOCK:
            return self._rlock()
        return found


def replaced(scheduler: Scheduler, files: Descriptors, packages: Iterable[str]) -> contextlib.ExitStack:
    """Replace the names in all modules of these packages, also in those imported later; closing it puts them back."""
    undo = contextlib.ExitStack()
    replacements = Replacements(scheduler, files)
    roots = {*PACKAGES, *packages}
    for module in _STANDARD:
        _replace_in(module, replacements, undo)
    handlers: list[Any] = [ref() for ref in logging._handlerList]  # type: ignore[attr-defined]
    for handler in handlers:
        if handler is not None and handler.lock is not None:
            _set(handler, "lock", replacements.get(handler.lock), undo)
    for name, module in list(sys.modules.items()):
        if _is_of(name, roots):
            _replace_in(module, replacements, undo)
    finder = _Finder(scheduler, roots, lambda module: _replace_in(module, replacements, undo))
    sys.meta_path.insert(0, finder)
    undo.callback(sys.meta_path.remove, finder)
    return undo


def _is_of(name: str, roots: set[str]) -> bool:
    return name.partition(".")[0] in roots and not name.startswith(_OWN)


class _Finder:
    """Replaces the names of modules that are imported while virtual time runs."""

    def __init__(self, scheduler: Scheduler, roots: set[str], loaded: Callable[[ModuleType], None]) -> None:
        self._scheduler = scheduler
        self._roots = roots
        self._loaded = loaded

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        if not _is_of(name, self._roots):
            return None
        for finder in sys.meta_path:
            spec: Any = None if finder is self else finder.find_spec(name, path, target)
            if spec is not None:
                spec.loader = _Loader(spec.loader, self._run)
                return spec
        return None

    def _run(self, run: Callable[[ModuleType], None], module: ModuleType) -> None:
        self._scheduler.importing += 1
        try:
            run(module)
            self._loaded(module)
        finally:
            self._scheduler.importing -= 1


class _Loader:
    """A loader with something to do around its modules. The real one may be shared: pytest has one for all tests."""

    def __init__(self, real: Any, around: Callable[[Callable[[ModuleType], None], ModuleType], None]) -> None:
        self._real, self._around = real, around

    def exec_module(self, module: ModuleType) -> None:
        self._around(self._real.exec_module, module)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)


class _ReplacedName(NamedTuple):
    """A name whose value is replaced, in a module or a class."""

    owner: Any
    name: str


_sites_of: dict[str, tuple[ModuleType, list[_ReplacedName]]] = {}
"""What was found in each module, which is looked for once."""


def _replace_in(module: ModuleType, replacements: Replacements, undo: contextlib.ExitStack) -> None:
    known = _sites_of.get(module.__name__)
    if known is None or known[0] is not module:
        known = _sites_of[module.__name__] = (module, list(_sites(module, replacements)))
    for owner, name in known[1]:
        value = vars(owner)[name] if isinstance(owner, type) else getattr(owner, name)
        undo.callback(setattr, owner, name, value)
        stand_in = replacements.get(value)
        of_class = isinstance(owner, type) and type(stand_in) is types.FunctionType
        setattr(owner, name, staticmethod(stand_in) if of_class else value if stand_in is None else stand_in)


def _sites(module: ModuleType, replacements: Replacements) -> Generator[_ReplacedName]:
    for name, value in list(vars(module).items()):
        if replacements.get(value) is not None:
            yield _ReplacedName(module, name)
        elif issubclass(type(value), type) and value.__module__ == module.__name__:
            for of_class, one in list(vars(cast("type", value)).items()):
                if replacements.get(one) is not None:
                    yield _ReplacedName(value, of_class)


def _set(owner: Any, name: str, value: Any, undo: contextlib.ExitStack) -> None:
    undo.callback(setattr, owner, name, getattr(owner, name))
    setattr(owner, name, value)


# --- stand-ins


def _clocks(scheduler: Scheduler) -> dict[str, Any]:
    def seconds() -> float:
        return scheduler.monotonic_ns() / 1e9

    def wall_s() -> float:
        return scheduler.wall_ns() / 1e9

    def by_clock(clock: int) -> int:
        return scheduler.wall_ns() if clock == time.CLOCK_REALTIME else scheduler.monotonic_ns()

    def clock_s(clock: int) -> float:
        return by_clock(clock) / 1e9

    return {
        "monotonic": seconds,
        "perf_counter": seconds,
        "clock_gettime": clock_s,
        "time": wall_s,
        "monotonic_ns": scheduler.monotonic_ns,
        "perf_counter_ns": scheduler.monotonic_ns,
        "clock_gettime_ns": by_clock,
        "time_ns": scheduler.wall_ns,
        "sleep": scheduler.sleep,
    }


def _queues(threads: ModuleType, clocks: ModuleType) -> Any:
    """The module `queue`, in pure Python over other threads."""
    spec: Any = importlib.util.find_spec("queue")
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.threading, module.time = threads, clocks.monotonic
    module.SimpleQueue = module._PySimpleQueue
    module.Empty, module.Full = queue.Empty, queue.Full
    return module


def _ids(scheduler: Scheduler) -> dict[str, Any]:
    drawn = scheduler.numbers
    return {
        "token_hex": lambda nbytes=16: drawn.randbytes(nbytes or 16).hex(),
        "token_bytes": lambda nbytes=16: drawn.randbytes(nbytes or 16),
        "randbits": drawn.getrandbits,
        "choice": drawn.choice,
        "randbelow": drawn.randrange,
    }


def _drawn(scheduler: Scheduler) -> dict[str, Any]:
    names = ("random", "uniform", "randrange", "randint", "choice", "shuffle", "sample", "getrandbits", "randbytes")
    return {name: getattr(scheduler.numbers, name) for name in names}


_REFUSED: Final = {
    "subprocess": ("Popen", "run", "check_call", "check_output", "call"),
    "multiprocessing": ("Process", "Pool"),
    "socketserver": ("TCPServer", "UDPServer"),
    "zenoh": ("open",),
}
"""What waits for something outside, by module."""


def _refused(real: Any, name: str) -> Any:
    def refuse(*_args: Any, **_named: Any) -> Any:
        raise VirtualTimeError(f"{name} was called: virtual time has threads of this process only")

    if not isinstance(real, type):
        return refuse
    kind: type[Any] = real
    return type(kind.__name__, (kind,), {"__new__": refuse})
