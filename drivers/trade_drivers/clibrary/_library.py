"""A C library whose functions become methods."""

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

from trade import current_call, effect_of
from trade.errors import ConfigurationError, DeadlineExceeded, DeviceError, InvalidArgument
from trade_drivers.clibrary._marshalling import Passing, is_never_negative, plan

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
    """A shared library, opened with the declarations of its header.

    ``c`` calls its functions directly, and ``ffi`` makes C values; both are cffi's. Functions run without the
    interpreter's lock, so other threads continue, and calls of one library can overlap. Mark a service that must not
    overlap with another one ``serial=True``. A stop does not wait for it, so the library must allow a stop during
    another call.

    Immediately before a function is called, its deadline and permit are checked again (S01, S08). A stop function is
    repeated while a motion function that passed this check still runs, because the library cannot notice a stop
    between the check and the first line of the function.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        header: str,
        *,
        failed: Callable[[int], bool] | None = None,
        text: str | None = None,
    ) -> None:
        """Opens the library.

        Args:
            path: of the shared library; the system's loader searches for a bare name.
            header: declarations of the types, structs and functions in use, without preprocessor lines.
            failed: returns whether a status means failure; by default, a status below zero or false does.
            text: a function that returns the text of a status, ``const char *name(int)``.

        Raises:
            ConfigurationError: the library cannot be opened, the declarations are invalid, or cffi is not installed.
        """
        self.path: Final = fspath(path)
        self._failed = failed
        self._moving: set[int] = set()
        """Calls of motion functions, from before their last check until they have returned."""
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
        """Implements a method by a C function; the method's own body stays empty.

        Its parameters are the first ones of the C function, in order, and are compared once, here. ``float``, ``int``
        and ``bool`` are numbers, ``str`` is ``const char *`` (UTF-8), ``list[float]`` and ``list[int]`` are a pointer
        and a count, and a dataclass is a struct by value. Pointers after them receive results: numbers, structs or
        arrays; several results are a tuple. Numbers that C cannot hold are refused, never truncated. Call functions
        with other conventions through ``c``.

        Args:
            name: of the C function.
            status: whether the function returns a status; by default, if its return value is not the method's result.
                False: the return value is discarded.
            handle: attribute of the object with the function's first argument, such as the result of ``open``.
            out: number of elements of each array that it returns.

        Returns:
            A decorator, placed below ``@service``. The method raises CFunctionFailed and InvalidArgument.

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

    # --- motion functions and stop functions

    def _let_in(self, call: Callable[..., Any], put: Sequence[Any]) -> Any:
        """Calls a motion function. Raises DeadlineExceeded, MotionStopped, LockLost, LockedByOther: too late."""
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
        """Repeats a stop until earlier motion functions have returned, for a limited time; the last result counts."""
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
