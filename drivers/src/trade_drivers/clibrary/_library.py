"""A C library and its functions as methods."""

import inspect
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Final, TypeVar, get_type_hints

from trade import current_call
from trade._services.decorator import effect_of
from trade.errors import ConfigurationError, DeadlineExceeded, DeviceError, InvalidArgument
from trade_drivers.clibrary._marshalling import Passing, is_never_negative, plan

__all__ = ["CFunctionFailed", "CLibrary"]

Method = TypeVar("Method", bound=Callable[..., Any])

_AGAIN_S: Final = 0.005
_STOPPED_WITHIN_S: Final = 2.0


@dataclass(kw_only=True, eq=False)
class CFunctionFailed(DeviceError, RuntimeError):
    """A function of a C library returned a status that means failure. ``bus`` is the library."""

    status: int
    text: str = ""

    def describe(self) -> str:
        return f"{self.device} of {self.bus} failed with status {self.status}" + (f": {self.text}" if self.text else "")


class CLibrary:
    """A shared library, opened by the declarations of its header.

    ``c`` calls its functions as they are, and ``ffi`` makes C values; both are cffi's. Functions are called without
    the interpreter's lock: other threads run on, and calls of one library may come at the same time. A service that
    must not run beside another one is marked ``serial=True``; a stop never waits for it, so what a library does when
    it is told to stop in the middle of another call has to be known.

    Right before a function is called, whether its call may still begin is looked at once more (S01, S08). A function
    that stops is called again while one that moves, and was let in before, still runs: between that last look and the
    first line of the other function no library can be told to stop.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        header: str,
        *,
        failed: Callable[[int], bool] | None = None,
        text: str | None = None,
    ) -> None:
        """Open it.

        Args:
            path: of the shared library; a bare name is looked for as the system's loader does.
            header: declarations of what is used, without preprocessor lines; types, structs and functions.
            failed: whether a status means failure, of functions that return one; by default one below zero does, and
                false.
            text: a function that makes a text of a status, ``const char *name(int)``.

        Raises:
            ConfigurationError: it cannot be opened or the declarations cannot be read; cffi is not installed.
        """
        self.path: Final = fspath(path)
        self._failed = failed
        self._moving: set[int] = set()
        """Calls of functions that move something: before their last look, until they have returned."""
        self._moves = 0
        self._guard = threading.Lock()
        self._text = text
        self.ffi: Final[Any] = _ffi(header, self.path)
        try:
            self.c: Final[Any] = self.ffi.dlopen(self.path)
        except OSError as error:
            raise ConfigurationError(where=self.path, problem=f"cannot be opened as a C library: {error}") from None

    def function(
        self, name: str, *, status: bool | None = None, handle: str | None = None, out: int | Sequence[int] = ()
    ) -> Callable[[Method], Method]:
        """Have a method do what a C function does; the method's own body stays empty.

        Its parameters are the C function's first ones, in order, compared here once: ``float``, ``int`` and ``bool``
        are numbers, ``str`` is ``const char *`` (UTF-8), ``list[float]`` and ``list[int]`` a pointer and the count
        after it, a dataclass a struct by value. Pointers after them are where the results come back: numbers,
        structs, arrays; of several the method returns a tuple. Numbers that C cannot hold are refused, never cut. A
        function that wants it otherwise is called through ``c``.

        Args:
            name: of the C function.
            status: whether what it returns says if it failed; by default, if it returns something that is not the
                method's result. False: it says something else, which is thrown away.
            handle: attribute of the object that is the function's first argument, such as what ``open`` returned.
            out: how many elements come back, of each array.

        Returns:
            A decorator; ``@service`` goes above it. The method raises CFunctionFailed, and InvalidArgument.

        Raises:
            ConfigurationError: there is no such function, or it does not fit the method.
        """

        def decorate(method: Method) -> Method:
            where = f"{method.__qualname__}, {name} of {self.path}"
            kind, call = self._look_up(where, name)
            signature, hints = inspect.signature(method), get_type_hints(method)
            wanted = {one: hints.get(one) for one in [*list(signature.parameters)[1:], "return"]}
            if missing := [one for one, hint in wanted.items() if hint is None]:
                raise ConfigurationError(
                    where=where, problem=f"the method does not say the type of {', '.join(missing)}"
                )
            lengths = (out,) if isinstance(out, int) else out
            passing = plan(self.ffi, where, kind, wanted, status=status, handle=handle is not None, lengths=lengths)
            if passing.has_status and self._failed is None and is_never_negative(kind.result):
                problem = (
                    f"it returns {kind.result.cname}, which is never below zero: say by failed= which mean failure"
                )
                raise ConfigurationError(where=where, problem=problem)
            return self._method(method, name, call, passing, handle)

        return decorate

    def _look_up(self, where: str, name: str) -> tuple[Any, Any]:
        try:
            call = getattr(self.c, name)
            kind = self.ffi.typeof(call)
        except (AttributeError, TypeError) as error:
            raise ConfigurationError(where=where, problem=f"there is no such function: {error}") from None
        if kind.kind != "function" or kind.ellipsis:
            raise ConfigurationError(where=where, problem=f"{kind.cname} cannot be a service")
        return kind, call

    def _method(self, method: Method, name: str, call: Any, passing: Passing, handle: str | None) -> Method:
        bind = inspect.signature(method).bind

        @wraps(method)
        def calls(*args: Any, **kwargs: Any) -> Any:
            bound = bind(*args, **kwargs)
            bound.apply_defaults()
            this, *given = bound.arguments.values()
            first = () if handle is None else (getattr(this, handle),)
            try:
                put, places = passing.into(first, given)
                returned = self._stop(call, put) if effect_of(calls) == "stop" else self._let_in(call, put)
            except (OverflowError, TypeError, ValueError) as bad:
                raise InvalidArgument(service=method.__name__, argument="", problem=str(bad)) from None
            if passing.has_status and self._has_failed(returned):
                raise CFunctionFailed(
                    device=name, bus=Path(self.path).name, status=returned, text=self._text_of(returned)
                )
            return passing.out_of(returned, places)

        return calls  # pyright: ignore[reportReturnType] - it has the signature of the method

    def _has_failed(self, status: int) -> bool:
        if self._failed is not None:
            return self._failed(status)
        return status is False or status < 0

    # --- what moves, and what stops it

    def _let_in(self, call: Callable[..., Any], put: Sequence[Any]) -> Any:
        """Raises DeadlineExceeded, MotionStopped, LockLost, LockedByOther: it must not begin any more."""
        asked = current_call()
        if asked is None or asked.permit is None:
            return call(*put)
        with self._noted():
            if asked.expires_ns is not None and time.monotonic_ns() >= asked.expires_ns:
                raise DeadlineExceeded(service=asked.service, deadline_s=0.0)
            asked.permit.gate()
            return call(*put)

    @contextmanager
    def _noted(self) -> Generator[None]:
        with self._guard:
            self._moves += 1
            number = self._moves
            self._moving.add(number)
        try:
            yield
        finally:
            with self._guard:
                self._moving.discard(number)

    def _stop(self, call: Callable[..., Any], put: Sequence[Any]) -> Any:
        """Until what was let in before has returned, for some time at most; what it returned last counts."""
        with self._guard:
            before = set(self._moving)
        until, returned = time.monotonic() + _STOPPED_WITHIN_S, call(*put)
        while before & self._moving and time.monotonic() < until:
            threading.Event().wait(_AGAIN_S)
            returned = call(*put)
        return returned

    def _text_of(self, status: int) -> str:
        if self._text is None:
            return ""
        text = getattr(self.c, self._text)(status)
        return "" if text == self.ffi.NULL else self.ffi.string(text).decode(errors="replace")


def _ffi(header: str, path: str) -> Any:
    try:
        import cffi  # noqa: PLC0415 - loaded only by who has a C library
    except ImportError:
        raise ConfigurationError(where=path, problem="needs cffi; pip install 'trade-drivers[c]'") from None
    ffi = cffi.FFI()
    try:
        ffi.cdef(header)
    except (cffi.CDefError, cffi.FFIError) as error:
        raise ConfigurationError(where=path, problem=f"its declarations cannot be read: {error}") from None
    return ffi
