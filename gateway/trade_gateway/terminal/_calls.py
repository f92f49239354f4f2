"""Calls of commands, which Ctrl-C and similar signals cancel."""

import signal
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from trade import Handle
from trade.errors import TradeError
from trade_gateway.terminal._output import say_error


def run_to_end(handle: Handle, *args: Any, **kwargs: Any) -> Any:
    """Calls a service; Ctrl-C and similar signals cancel the call and raise KeyboardInterrupt."""
    with _interruptible():
        run = handle.start(*args, **kwargs)
        try:
            return run.result()
        except KeyboardInterrupt:
            _cancel(handle)
            raise


@contextmanager
def _interruptible() -> Generator[None]:
    """Makes SIGTERM and SIGHUP end a call as Ctrl-C does, so that its motion is stopped."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    before = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _cancel(handle: Handle) -> None:
    """Cancels the call after Ctrl-C, and reports if that failed."""
    try:
        handle.cancel_service()()
    except TradeError as error:
        say_error(error)
