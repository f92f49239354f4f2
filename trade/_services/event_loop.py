"""The event loop on which a container's ``async def`` services run."""

import asyncio
import concurrent.futures
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any

from trade._context.call_context import CallContext
from trade.errors import Cancelled, OutcomeUnknown
from trade.protocol.remote_errors import pack_error, unpack_error


class AsyncLoop:
    """The event loop on which a container's ``async def`` services run; the first of them starts it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def complete(self, coroutine: Coroutine[Any, Any, Any], context: CallContext) -> Any:
        """Run an ``async def`` service from a handler thread; its deadline cancels it."""
        allowed_s = context.remaining_s
        future = self._submit(_contained(coroutine, context))
        if future is None:
            coroutine.close()
            raise Cancelled(service=context.service)
        done, _ = concurrent.futures.wait([future], allowed_s)
        if allowed_s is not None and not done:
            future.cancel()
            raise OutcomeUnknown(service=context.service, deadline_s=allowed_s)
        try:
            return future.result()
        except concurrent.futures.CancelledError:
            raise Cancelled(service=context.service) from None

    def _submit(self, coroutine: Coroutine[Any, Any, Any]) -> "concurrent.futures.Future[Any] | None":
        """Start a coroutine, unless the loop is closed; closing cancels all coroutines, so each of them ends."""
        with self._lock:
            if self._closed:
                coroutine.close()
                return None
            if self._loop is None:
                self._loop = asyncio.new_event_loop()
                self._thread = threading.Thread(target=_run_loop, args=(self._loop,), name="trade-async", daemon=True)
                self._thread.start()
            return asyncio.run_coroutine_threadsafe(coroutine, self._loop)

    def close(self) -> None:
        """Cancel what still runs and end the thread. Idempotent."""
        with self._lock:
            self._closed = True
            loop, thread = self._loop, self._thread
            self._loop = self._thread = None
        if loop is not None and thread is not None:
            loop.call_soon_threadsafe(loop.stop)
            if thread is not threading.current_thread():
                thread.join(2)


async def _contained(coroutine: Coroutine[Any, Any, Any], context: CallContext) -> Any:
    """Turns what would end the loop for all coroutines into an error for the caller, who may also cancel the call."""
    loop, task = asyncio.get_running_loop(), asyncio.current_task()

    def cancel() -> None:
        if task is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: everything on it was cancelled
                loop.call_soon_threadsafe(task.cancel)

    context.on_cancel(cancel)
    try:
        return await coroutine
    except (SystemExit, KeyboardInterrupt) as error:
        raise unpack_error(pack_error(error), context.service) from error


def _run_loop(loop: asyncio.AbstractEventLoop) -> None:
    try:
        loop.run_forever()
        loop.run_until_complete(_cancel_all())
        loop.run_until_complete(loop.shutdown_asyncgens())
    finally:
        loop.close()


async def _cancel_all() -> None:
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
