"""The latest log lines of this process, each with the call that it was logged in."""

import logging
import secrets
import threading
from collections import deque
from typing import Final

from msgspec import Struct

from trade._context.call_context import running

_MOST: Final = 2000
_LONGEST: Final = 2000
_PATIENCE_S: Final = 0.1


class LogLine(Struct, frozen=True, kw_only=True):
    """One line of the logger ``trade``, without its traceback."""

    process: str
    """Identifies the process; containers of one process report the same lines."""
    number: int
    """Counts the lines of the process, from 1."""
    at: float
    """``time.time()`` of its host."""
    level: int
    text: str
    call_id: int
    """The call that logged it; 0 for none."""
    outer_id: int = 0
    """The outermost call that led to it: one id for all lines that it causes, in all processes."""
    container: str = ""
    """The container that reported it."""

    @property
    def level_name(self) -> str:
        """Such as ``WARNING``."""
        return logging.getLevelName(self.level)


class Logbook(logging.Filter):
    """Sees each line of the logger that passes its level, and keeps the newest; lets all of them pass.

    A filter and not a handler: with a handler, a program without a logging set-up would no longer show anything.
    """

    def __init__(self) -> None:
        super().__init__()
        self._process = secrets.token_hex(6)
        self._lock = threading.Lock()
        self._lines: deque[LogLine] = deque(maxlen=_MOST)
        self._count = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Keep a line, and add ``call_id`` and ``outer_id`` for formatters."""
        call = running.get()
        call_id: int = getattr(record, "call_id", 0) or (0 if call is None else call.id)
        outer_id: int = getattr(record, "outer_id", 0)
        if not outer_id:
            outer_id = call_id if call is None or call.id != call_id else call.outer_id
        record.call_id, record.outer_id = call_id, outer_id
        if self._lock.acquire(timeout=_PATIENCE_S):  # in a forked child its holder may not exist
            try:
                self._count += 1
                self._lines.append(
                    LogLine(
                        process=self._process,
                        number=self._count,
                        at=record.created,
                        level=record.levelno,
                        text=_text(record)[:_LONGEST],
                        call_id=call_id,
                        outer_id=outer_id,
                    )
                )
            finally:
                self._lock.release()
        return True

    def lines(self, after: int = 0) -> list[LogLine]:
        """The lines kept with a higher number, oldest first."""
        with self._lock:
            return [line for line in self._lines if line.number > after]


def _text(record: logging.LogRecord) -> str:
    try:
        text = record.getMessage()
    except Exception:  # noqa: BLE001 - arguments that do not match; the handler reports that
        text = str(record.msg)
    kind = record.exc_info[0] if record.exc_info else None
    return text if kind is None else f"{text} ({kind.__name__})"


logbook: Final = Logbook()
"""The log buffer of this process; active from its first container on."""


def listen() -> None:
    """Keep lines from now on."""
    logging.getLogger("trade").addFilter(logbook)
