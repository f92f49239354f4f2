"""Writes audit events: one thread, fed by a queue that never blocks its callers."""

import importlib.metadata
import json
import logging
import os
import socket
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from trade._audit.events import Event
from trade._audit.hash_chain import AuditRow, Head
from trade._audit.store import SUFFIX, AuditStore, Retention, move_aside
from trade._context.sessions import foreign
from trade._settings import Settings
from trade.protocol.keys import Address, ServiceKey

_logger = logging.getLogger("trade")

_MOST: Final = 20_000
"""The largest number of waiting events; further ones are counted, and lost."""
_BATCH: Final = 1_000
_GATHER_S: Final = 0.1
"""How long events are collected before they are written together."""
_AGAIN_S: Final = 1.0
"""The pause before the next attempt to write."""
_LOOK_S: Final = 3600.0
"""How often old rows are dropped, and the end of the record is logged."""
_PARTING_S: Final = 3.0
_LONGEST: Final = 500
_MOST_ID: Final = (1 << 63) - 1
_JUMP_NS: Final = 2_000_000_000
"""The difference from the monotonic clock above which the wall clock counts as set."""
_FAR_NS: Final = 86_400_000_000_000
"""After a jump this large no row is dropped for its age: the clock may be wrong."""
_EVER_DAYS: Final = 1_000_000


class AuditWriter:
    """Owns the record of one container.

    On close, it writes what it can, and logs the number of rows that it cannot write.

    Args:
        path: of the file; created when the first event is written.
        boot: the epoch of the container.
        about: the details of the first row of this boot.
        keep: the limits for keeping rows.
    """

    def __init__(
        self,
        path: Path,
        boot: str,
        about: str,
        keep: Retention,
        clocks: Callable[[], tuple[int, int]] = lambda: (time.time_ns(), time.monotonic_ns()),
    ) -> None:
        self._path = path
        self._boot = boot
        self._keep = keep
        self._clocks = clocks
        self._offset_ns = self._offset()
        self._far = False
        """The clock was set by so much that ages are meaningless."""
        self._waiting: deque[Event] = deque()
        self._some = threading.Event()
        self._closing = threading.Event()
        self._guard = threading.Lock()
        self._lost = 0
        self.lost = 0
        """The number of events lost since the start."""
        self.written = 0
        self._rows: list[AuditRow] = [self._row("began", about)]
        """The next rows to write; kept until they are written."""
        self._to_drop = False
        """Whether to look for rows to drop."""
        self._unlooked = 0
        """Rows written since the last time."""
        self._store: AuditStore | None = None
        self._head = Head(0, b"")
        self._trouble = ""
        self._some.set()
        self._thread = threading.Thread(target=self._run, name="trade-audit", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """The number of events not yet written."""
        return len(self._waiting)

    @property
    def running(self) -> bool:
        """Whether it still writes, or tries to."""
        return self._thread.is_alive()

    def tell(self, event: Event) -> None:
        """Take an event, on any thread, without blocking."""
        if len(self._waiting) >= _MOST:
            with self._guard:
                self._lost += 1
                self.lost += 1
            return
        self._waiting.append(event)
        if not self._some.is_set():
            self._some.set()

    # --- on its own thread

    def _run(self) -> None:
        looked = time.monotonic()
        while not self._closing.is_set():
            self._some.wait(max(0.0, looked + _LOOK_S - time.monotonic()))
            self._closing.wait(_GATHER_S)
            self._some.clear()
            if time.monotonic() - looked >= _LOOK_S:
                looked, self._to_drop = time.monotonic(), True
                self._log_head("is at")
            self._write_all(last=False)
        self._write_all(last=True)
        self._part()

    def _write_all(self, *, last: bool) -> None:
        while self._waiting or self._rows or self._lost or (self._to_drop and not last):
            self._gather()
            if self._write() and (last or self._drop()):
                continue
            if last or self._closing.wait(_AGAIN_S):
                return

    def _gather(self) -> None:
        if self._rows:  # from a failed attempt
            return
        offset_ns = self._offset()
        if abs(jump_ns := offset_ns - self._offset_ns) >= _JUMP_NS:
            self._offset_ns = offset_ns
            self._far = self._far or abs(jump_ns) >= _FAR_NS
            self._rows.append(self._row("clock set", f"by {jump_ns / 1e9:+.3f} s"))
        if self._lost:
            with self._guard:
                lost, self._lost = self._lost, 0
            self._rows.append(self._row("lost", f"{lost} records that could not be written in time"))
        for _ in range(min(_BATCH, len(self._waiting))):
            self._rows.append(_row_of(self._waiting.popleft(), self._boot))

    def _write(self, *, retry: bool = True) -> bool:
        """Write the rows, into a new file if the present one is corrupt. Returns whether that succeeded."""
        fresh = self._store is None
        try:
            self._store = self._store or AuditStore(self._path)
            self._head = self._store.add(self._rows)
        except (sqlite3.OperationalError, OSError) as trouble:  # no space, no permission, read-only: may be temporary
            self._log_trouble(str(trouble))
            return False
        except sqlite3.DatabaseError as broken:
            self._close_store()
            return retry and self._move_aside(str(broken)) and self._write(retry=False)
        self.written += len(self._rows)
        self._unlooked += len(self._rows)
        self._to_drop = self._to_drop or fresh or self._unlooked >= 10 * self._keep.piece
        self._rows.clear()
        if self._trouble:
            self._trouble = ""
            _logger.warning("audit: %s is written again", self._path)
        if fresh:
            self._log_head("continues at")
        return True

    def _log_trouble(self, trouble: str) -> None:
        self._close_store()
        if trouble != self._trouble:  # the same trouble again is not news
            self._trouble = trouble
            _logger.error(
                "audit: %s cannot be written: %s; trying again every %g s, and up to %d records wait",
                self._path,
                trouble,
                _AGAIN_S,
                _MOST,
            )

    def _move_aside(self, broken: str) -> bool:
        try:
            aside = move_aside(self._path, str(self._clocks()[0] // 1_000_000))
        except OSError as trouble:
            self._log_trouble(f"it is broken ({broken}), and cannot be moved aside: {trouble}")
            return False
        _logger.error("audit: %s is broken (%s); it is %s now, a new one was started", self._path, broken, aside.name)
        self._rows.insert(
            0, self._row("began again", f"the record before is broken, and is {aside.name} now: {broken}")
        )
        return True

    def _drop(self) -> bool:
        """Drop some rows that need not be kept, if it is time to. Returns whether that succeeded."""
        if not self._to_drop or self._store is None:
            return True
        keep = self._keep._replace(days=_EVER_DAYS) if self._far else self._keep
        try:
            self._to_drop = self._store.drop(keep, self._row("", "")) > 0
        except (sqlite3.Error, OSError) as trouble:
            self._log_trouble(f"old rows cannot be dropped: {trouble}")
            return False
        self._unlooked = 0
        return True

    def _part(self) -> None:
        if not self._rows and not self._waiting:
            self._rows.append(self._row("ended", ""))
            self._write()
        if unwritten := sum(row.kind != "audit" for row in self._rows) + len(self._waiting):
            _logger.error("audit: %d records of %s were never written", unwritten, self._path)
        self._log_head("ends at")
        self._close_store()

    def _close_store(self) -> None:
        if self._store is not None:
            self._store.close()
            self._store = None

    def _log_head(self, verb: str) -> None:
        """Log the newest row and its hash, as evidence outside the file."""
        if self._head.seq:
            _logger.info("audit: %s %s row %d, %s", self._path, verb, self._head.seq, self._head.hash.hex())

    def _row(self, what: str, about: str) -> AuditRow:
        at_ns, now_ns = self._clocks()
        return AuditRow(0, at_ns, now_ns, self._boot, "audit", what, about, "", "", 0, 0, "ok", "", 0)

    def _offset(self) -> int:
        at_ns, now_ns = self._clocks()
        return at_ns - now_ns

    def close(self) -> None:
        """Write the waiting events, for a few seconds at most. Idempotent."""
        self._closing.set()
        self._some.set()
        if self._thread is not threading.current_thread():
            self._thread.join(_PARTING_S)
            if self.running:
                _logger.error("audit: %s is still blocked after %g s; waiting rows may be lost", self._path, _PARTING_S)


def _row_of(event: Event, boot: str) -> AuditRow:
    return AuditRow(
        0,
        event.at_ns,
        event.monotonic_ns,
        boot,
        event.kind,
        _clipped(event.what),
        _clipped(_text(event.about)),
        _clipped(foreign(event.session) or event.who),
        _clipped(event.session),
        event.call_id & _MOST_ID,
        event.outer_id & _MOST_ID,
        event.outcome,
        _clipped(event.why),
        event.took_ns,
    )


def _clipped(text: str) -> str:
    """The part of a text that can be written, at a readable length."""
    text = text[:_LONGEST]
    return text if text.isascii() else text.encode(errors="replace").decode()


def _text(about: Any) -> str:
    """Details as text; shortened where a caller may have made them of any length."""
    if isinstance(about, str):
        return about
    if isinstance(key := getattr(about, "key", None), ServiceKey):  # a handle
        return f"{key.address}: {about.label}"
    if isinstance(about, Sequence) and not isinstance(about, bytes):
        return ", ".join(_text(one) for one in about[:100])  # pyright: ignore[reportUnknownVariableType]
    return str(about) if isinstance(about, bool | int | float | Path) else type(about).__name__


def start_writing(settings: Settings, folder: Path, own: Address) -> AuditWriter:
    """The writer of a container's record in a folder; its first row names the container and its policy."""
    about = {
        "container": own.container,
        "identity": own.identity,
        "system": settings.system,
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "version": importlib.metadata.version("trade-core"),
        "policy": str(settings.policy or ""),
    }
    keep = Retention(settings.audit_keep_days, settings.audit_keep_rows)
    return AuditWriter(folder / f"{own.container}{SUFFIX}", own.epoch, json.dumps(about), keep)
