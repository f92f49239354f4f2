"""Runs: calls that were started without waiting."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Generator
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, Protocol

from trade._context.active_calls import ActiveCall, end_calls
from trade._registry.registry import Record
from trade._threads.condition import InterruptibleCondition
from trade.errors import OutcomeUnknown

if TYPE_CHECKING:
    from typing_extensions import TypeVar  # every type checker has it

    _Result = TypeVar("_Result", default=Any)
else:
    from typing import TypeVar

    _Result = TypeVar("_Result")

_logger = logging.getLogger("trade")


class RunHandle(Protocol):
    """A handle, as its runs use it. Implemented by `trade.Handle`."""

    @property
    def label(self) -> str: ...
    @property
    def record(self) -> Record: ...
    def __call__(self) -> Any: ...
    def start(self) -> "Run[Any]": ...
    def cancel_service(self) -> "RunHandle": ...
    def log_not_cancelled(self, error: BaseException) -> None: ...


class Run(Generic[_Result]):
    """A call under way. Wait with ``result()`` or ``await``; it ends at its deadline at the latest.

    Type checkers know the type of its result if the call was made with `trade.start_call`.
    """

    def __init__(self, handle: RunHandle) -> None:
        self._handle = handle
        self._outcome: tuple[Any, BaseException | None] | None = None
        """Its result or its error, once it has ended."""
        self._ended = InterruptibleCondition()
        self._done_callbacks: list[Callable[[Run], object]] = []
        self._progress: Any = None
        self._on_progress: Callable[[Any], object] | None = None
        self._cancelling = False
        self._cancel_call: Callable[[], None] | None = None

    def __repr__(self) -> str:
        state = "under way" if self._outcome is None else "ended" if self._outcome[1] is None else "failed"
        return f"<Run of {self._handle.label}, {state}>"

    def result(self, timeout_s: float | None = None) -> _Result:
        """Returns the service's result, or raises its error.

        Args:
            timeout_s: how long to wait, in seconds.

        Raises:
            TimeoutError: the service has not answered in time; the call continues.
        """
        result, error = self._wait(timeout_s)
        if error is not None:
            raise error
        return result

    def done(self) -> bool:
        """Whether it has ended, with a result or an error."""
        return self._outcome is not None

    def exception(self, timeout_s: float | None = None) -> BaseException | None:
        """The error it ended with, or None."""
        return self._wait(timeout_s)[1]

    def _wait(self, timeout_s: float | None) -> tuple[Any, BaseException | None]:
        if self._outcome is None:
            self._ended.wait_for(self.done, timeout_s)
        if self._outcome is None:
            raise TimeoutError(f"{self._handle} has not ended after {timeout_s} s; it continues")
        return self._outcome

    def add_done_callback(self, callback: "Callable[[Run], object]") -> None:
        """Calls this when the run has ended, on the thread that notices it; at once if it has."""
        self._done_callbacks.append(callback)
        if self._outcome is not None:
            self._call_back()

    def _call_back(self) -> None:
        """Calls each done callback once, on whichever thread is first."""
        while self._done_callbacks:
            try:
                callback = self._done_callbacks.pop(0)
            except IndexError:  # another thread has called the last one
                return
            try:
                callback(self)
            except Exception:
                _logger.exception("a callback at the end of %s failed", self._handle)

    def cancel(self) -> None:
        """Cancels the call; the result then shows how it ended.

        A call that has not begun never begins, and raises Cancelled. A running one is asked to end, and continues if
        it ignores that. If its provider names a service that cancels it, that is called and waited for.
        """
        if self._outcome is not None:
            return
        self.ask_to_end()
        if self._handle.record.info.cancel is not None:
            self._handle.cancel_service()()

    def end_soon(self) -> None:
        """Does what `cancel` does, without waiting for it; only the first call has an effect."""
        if not self._cancelling and self._outcome is None:
            self._soon(self.ask_to_end)
            self._soon(self._call_cancel_service)

    def _call_cancel_service(self) -> None:
        """Calls the service that cancels it, if its provider names one."""

        def log_failure(cancel_run: Run) -> None:
            if (error := cancel_run.exception()) is not None:
                self._handle.log_not_cancelled(error)

        if self._handle.record.info.cancel is not None:
            self._handle.cancel_service().start().add_done_callback(log_failure)

    def _soon(self, do: Callable[[], None]) -> None:
        try:
            do()
        except Exception as error:  # noqa: BLE001 - the container may be gone, and the call with it
            self._handle.log_not_cancelled(error)

    def ask_to_end(self) -> None:
        """Does the first part of `cancel`: asks the call itself to end. Does not wait."""
        self._cancelling = True
        cancel = self._cancel_call
        if cancel is not None:
            cancel()

    def progress(self) -> Any:
        """The latest progress that the service has reported, or None."""
        return self._progress

    @property
    def cancelling(self) -> bool:
        """Whether ``cancel()`` was called."""
        return self._cancelling

    def on_cancel(self, cancel: Callable[[], None]) -> None:
        """Sets how the call is asked to end; called by the container. It must be idempotent, as it may run twice."""
        self._cancel_call = cancel
        if self._cancelling:
            cancel()

    def note_progress(self, value: Any) -> None:
        """Takes progress that the service has reported; called by the container."""
        self._progress = value
        if self._on_progress is not None:
            self._on_progress(value)

    def on_progress(self, callback: Callable[[Any], object]) -> None:
        """Calls this with each progress value, on the thread that receives it; with the latest one at once."""
        self._on_progress = callback
        if self._progress is not None:
            callback(self._progress)

    def fail(self, error: BaseException) -> None:
        """Ends the run with an error, because the call could not begin; called by the container."""
        self._end(None, error)

    def end(self, outcome: Callable[[], Any]) -> None:
        """Ends the run with what this returns or raises; called by the container."""
        try:
            result = outcome()
        except BaseException as error:  # noqa: BLE001 - `result` raises it
            self._end(None, error)
        else:
            self._end(result, None)

    def _end(self, result: Any, error: BaseException | None) -> None:
        self._outcome = (result, error)
        self._ended.notify_all()
        self._call_back()

    def end_with(self, outer: ActiveCall) -> Callable[[], None]:
        """Ends the run when its outer call is cancelled; called by the container. Returns a function that undoes this.

        The service that cancels it is also called at its deadline, when it is unknown whether it ended.
        """
        context = copy_context()  # its session and its locks

        def end() -> None:
            end_calls([partial(context.run, self.end_soon)])

        def cancel_service() -> None:
            self._soon(self._call_cancel_service)

        def cancel_if_unknown(_: object) -> None:
            forget()
            if isinstance(self.exception(0), OutcomeUnknown):
                end_calls([partial(context.run, cancel_service)])

        forget = outer.on_cancel(end)
        self.add_done_callback(cancel_if_unknown)
        return forget

    async def settled(self) -> None:
        """Waits from asyncio until it has ended, with a result or an error; cancelling this wait does not cancel it."""
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def set_ended(_: object) -> None:
            with contextlib.suppress(RuntimeError):  # that loop has ended
                loop.call_soon_threadsafe(ended.set)

        self.add_done_callback(set_ended)
        await ended.wait()

    def __await__(self) -> Generator[Any, None, _Result]:
        return self._awaited().__await__()

    async def _awaited(self) -> _Result:
        await self.settled()
        return self.result()
