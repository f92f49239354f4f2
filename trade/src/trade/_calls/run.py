"""Calls that were started without waiting."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Generator
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any

from trade._context.active_calls import ActiveCall, end_calls
from trade._threads.condition import InterruptibleCondition
from trade.errors import OutcomeUnknown

if TYPE_CHECKING:
    from trade._calls.handle import Handle

__all__ = ["Run"]

_logger = logging.getLogger("trade")


class Run:
    """A call under way. Wait with ``result()`` or ``await``; every one ends at its deadline at the latest."""

    def __init__(self, handle: "Handle") -> None:
        self._handle = handle
        self._outcome: tuple[Any, BaseException | None] | None = None
        """Its result or its error, once it has ended."""
        self._ended = InterruptibleCondition()
        self._told: list[Callable[[Run], object]] = []
        self._progress: Any = None
        self._on_progress: Callable[[Any], object] | None = None
        self._cancelling = False
        self._cancel_call: Callable[[], None] | None = None

    def __repr__(self) -> str:
        state = "under way" if self._outcome is None else "ended" if self._outcome[1] is None else "failed"
        return f"<Run of {self._handle.label}, {state}>"

    def result(self, timeout_s: float | None = None) -> Any:
        """The service's result, or its error raised.

        Args:
            timeout_s: give up waiting (not the call) after this long; raises TimeoutError.
        """
        result, error = self._wait(timeout_s)
        if error is not None:
            raise error
        return result

    def done(self) -> bool:
        """Whether it has ended, well or not."""
        return self._outcome is not None

    def exception(self, timeout_s: float | None = None) -> BaseException | None:
        """The error it ended with, or None."""
        return self._wait(timeout_s)[1]

    def _wait(self, timeout_s: float | None) -> tuple[Any, BaseException | None]:
        if self._outcome is None:
            self._ended.wait_for(self.done, timeout_s)
        if self._outcome is None:
            raise TimeoutError(f"{self._handle} has not ended after {timeout_s} s; it goes on")
        return self._outcome

    def when_done(self, tell: "Callable[[Run], object]") -> None:
        """Have this called once it has ended, on the thread that learns of it; at once if it has."""
        self._told.append(tell)
        if self._outcome is not None:
            self._tell()

    def _tell(self) -> None:
        """Each once, whichever thread comes first."""
        while self._told:
            try:
                tell = self._told.pop(0)
            except IndexError:  # another thread has told the last one
                return
            try:
                tell(self)
            except Exception:
                _logger.exception("who was to learn that %s has ended failed", self._handle)

    def cancel(self) -> None:
        """End it early; the result then tells how it ended.

        A call that has not begun never will, and raises Cancelled. One that runs is asked to end, and goes on if
        it does not heed that. If its provider names a service that ends it, that is called, and waited for.
        """
        if self._outcome is not None:
            return
        self.ask_to_end()
        if self._handle.record.info.cancel is not None:
            self._handle.cancel_service()()

    def end_soon(self) -> None:
        """What `cancel` does, without waiting: what ends the call is under way when this returns. Once."""
        if not self._cancelling and self._outcome is None:
            self._soon(self.ask_to_end)
            self._soon(self._call_off)

    def _call_off(self) -> None:
        """Have the service called that ends it, if its provider names one."""

        def look(stopping: Run) -> None:
            if (error := stopping.exception()) is not None:
                self._handle.note_not_cancelled(error)

        if self._handle.record.info.cancel is not None:
            self._handle.cancel_service().start().when_done(look)

    def _soon(self, do: Callable[[], None]) -> None:
        try:
            do()
        except Exception as error:  # noqa: BLE001 - a container that is gone, say: the call is, too
            self._handle.note_not_cancelled(error)

    def ask_to_end(self) -> None:
        """What `cancel` does first: ask the call alone to end. Does not wait."""
        self._cancelling = True
        tell = self._cancel_call
        if tell is not None:
            tell()

    def progress(self) -> Any:
        """What the service said last of how far it is, or None."""
        return self._progress

    @property
    def cancelling(self) -> bool:
        """Whether ``cancel()`` was called."""
        return self._cancelling

    def on_cancel(self, tell: Callable[[], None]) -> None:
        """Told by the container: how to ask the call to end. Idempotent itself, as it may be used twice."""
        self._cancel_call = tell
        if self._cancelling:
            tell()

    def note_progress(self, value: Any) -> None:
        """Told by the container: the service said this of how far it is."""
        self._progress = value
        if self._on_progress is not None:
            self._on_progress(value)

    def on_progress(self, tell: Callable[[Any], object]) -> None:
        """Have this called with each that comes, on the thread that hears of it; with the last one at once."""
        self._on_progress = tell
        if self._progress is not None:
            tell(self._progress)

    def fail(self, error: BaseException) -> None:
        """Told by the container: it could not begin."""
        self._end(None, error)

    def end(self, outcome: Callable[[], Any]) -> None:
        """Told by the container: the outcome is what this returns or raises."""
        try:
            result = outcome()
        except BaseException as error:  # noqa: BLE001 - whatever the service raised belongs to who asks for the result
            self._end(None, error)
        else:
            self._end(result, None)

    def _end(self, result: Any, error: BaseException | None) -> None:
        self._outcome = (result, error)
        self._ended.notify_all()
        self._tell()

    def end_with(self, outer: ActiveCall) -> Callable[[], None]:
        """Told by the container: it is made inside another call, and ends with that. Returns what takes that back.

        Also at its deadline, when nobody knows whether it ended: what ends it is called all the same.
        """
        around = copy_context()  # for whom, and under which locks

        def end() -> None:
            end_calls([partial(around.run, self.end_soon)])

        def call_off() -> None:
            self._soon(self._call_off)

        def look(_: object) -> None:
            forget()
            if isinstance(self.exception(0), OutcomeUnknown):
                end_calls([partial(around.run, call_off)])

        forget = outer.on_cancel(end)
        self.when_done(look)
        return forget

    async def settled(self) -> None:
        """Wait for its end from asyncio, well or not; the service goes on if this waiting is cancelled."""
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def tell(_: object) -> None:
            with contextlib.suppress(RuntimeError):  # nobody waits any more: that loop has ended
                loop.call_soon_threadsafe(ended.set)

        self.when_done(tell)
        await ended.wait()

    def __await__(self) -> Generator[Any, None, Any]:
        return self._awaited().__await__()

    async def _awaited(self) -> Any:
        await self.settled()
        return self.result()
