"""The fault log of a robot, with its services."""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, wait
from typing import Annotated, Final

from msgspec import Struct, structs

from trade import Meta, current_call, service
from trade.errors import InvalidArgument
from trade_drivers.faults._fault_update import DetectedFault
from trade_drivers.faults._record import Fault, FaultInfo, Moment, info_of, samples_of
from trade_drivers.faults._store import FaultStore, Kept, Key

_logger = logging.getLogger("trade")

_MOST: Final = 200
"""How many kinds of fault are kept; ended and acknowledged ones are dropped first, oldest first."""
_SAVE_EVERY_S: Final = 1.0
_AGAIN_S: Final = 5.0
"""A fault that was open when the previous process ended, and is found again within this time, is not counted again."""
_DISK_S: Final = 10.0
_MOST_EVIDENCE: Final = 16
_REPORT_EVERY_S: Final = 10.0
"""A fault that comes and goes is reported no more often."""

Id = Annotated[str, Meta(description="id of a fault, as faults() returns it: rosie-3f2a")]
Note = Annotated[str, Meta(min_length=1, max_length=500, description="a finding, and where its evidence is")]


class _Entry(Struct):
    """The record of one fault in this process."""

    fault: Fault
    number: int
    """Numbers faults in the order of their beginning, independent of the wall clock."""
    began_s: float = 0.0
    """When the fault last began, by the monotonic clock of this process."""
    moments: tuple[Moment, ...] = ()
    """The measurements of that time, until a client requests them as samples."""


class FaultLog:
    """Faults of the devices of one robot. Acknowledging a fault clears nothing in a device and moves nothing.

    Args:
        robot: the name of the robot.
        store: the storage where faults outlive the process; None if there is none.
        clock: ``time.monotonic``.
        wall: ``time.time``.
        most: how many kinds are kept.
        devices: whose saved faults it takes; those of others belong to another process of the robot. None: all.
    """

    def __init__(
        self,
        robot: str,
        store: FaultStore | None = None,
        *,
        clock: Callable[[], float] | None = None,
        wall: Callable[[], float] | None = None,
        most: int = _MOST,
        devices: Collection[str] | None = None,
    ) -> None:
        self._robot, self._store, self._most = robot, store, most
        self.report: Callable[[str], object] = _logger.warning
        """Called with the text of each fault that begins; a program that shows faults in its own way replaces it."""
        self._reported: dict[Key, float] = {}
        """When each fault was reported last, by the monotonic clock."""
        self._clock, self._wall = clock or time.monotonic, wall or time.time
        self._lock = threading.Lock()
        self._entries: dict[Key, _Entry] = {}
        self._before: set[Key] = set()
        """Faults that were open when the previous process ended, and have not been found since."""
        self._number = 0
        self._unsaved: set[Key] = set()
        self._sent: set[Key] = set()
        """Faults of the last write to disk, which may have failed."""
        self._saving: Future[bool] | None = None
        self._saved_s = -_SAVE_EVERY_S
        self._started_s = self._clock()
        for number, fault in store.load() if store is not None else ():
            if devices is None or fault.device in devices:
                self._restore(number, fault)

    def _restore(self, number: int, fault: Fault) -> None:
        key = (fault.device, fault.kind)
        self._number = max(self._number, number)
        if fault.open:
            self._before.add(key)
            self._unsaved.add(key)
            fault = structs.replace(fault, open=False, gone_at=self._wall())
        self._entries[key] = _Entry(fault, number)

    # --- services

    @service(effect="read")
    def faults(self, open_only: bool = False) -> list[FaultInfo]:
        """Returns all recorded kinds of faults, newest first; with ``open_only``, only current ones."""
        with self._lock:
            entries = sorted(self._entries.values(), key=lambda entry: -entry.number)
            return [info_of(self._current(entry)) for entry in entries if entry.fault.open or not open_only]

    @service(effect="read")
    def fault(self, id: Id) -> Fault:  # noqa: A002 - as it is called everywhere
        """Returns one fault with its device's measurements before the first and the latest beginning.

        Raises:
            InvalidArgument: there is no fault with this id.
        """
        with self._lock:
            return self._current(self._found(id, "fault"))

    @service(effect="note")
    def acknowledge(self, id: Id) -> FaultInfo:  # noqa: A002
        """Marks a fault as seen by the caller. It stays until its cause is gone; a new occurrence is unseen again.

        Raises:
            InvalidArgument: there is no fault with this id.
        """
        call = current_call()
        by = "its own process" if call is None else call.asker
        with self._lock:
            entry = self._found(id, "acknowledge")
            self._change(entry, acknowledged_by=by, acknowledged_at=self._wall())
            return info_of(self._current(entry))

    @service(effect="note")
    def add_evidence(self, id: Id, note: Note) -> FaultInfo:  # noqa: A002
        """Attaches a finding to a fault, such as the place of a picture; the newest 16 are kept.

        Raises:
            InvalidArgument: there is no fault with this id.
        """
        with self._lock:
            entry = self._found(id, "add_evidence")
            self._change(entry, evidence=[*entry.fault.evidence, note][-_MOST_EVIDENCE:])
            return info_of(self._current(entry))

    # --- for fault detectors

    def begin(self, device: str, found: DetectedFault, at: float, at_s: float, moments: Sequence[Moment] = ()) -> None:
        """Records the beginning of a fault.

        Args:
            device: the name of the device.
            found: the fault.
            at: seconds since the epoch.
            at_s: the same time by the monotonic clock.
            moments: the device's measurements before, oldest first.
        """
        key = (device, found.kind)
        with self._lock:
            entry = self._entries.get(key)
            same = key in self._before and at_s - self._started_s < _AGAIN_S
            self._before.discard(key)
            if entry is None:
                self._add(key, found, at, at_s, moments)
            elif same:
                entry.began_s = at_s
                self._change(entry, open=True, gone_at=None, text=found.text, remedy=found.remedy)
            elif not entry.fault.open:
                self._begin_again(entry, found, at, at_s, moments)
            else:
                return
            if at_s < self._reported.get(key, -_REPORT_EVERY_S) + _REPORT_EVERY_S:
                return
            self._reported[key] = at_s
        self.report(found.text)

    def end(self, device: str, kind: str, at: float, at_s: float) -> None:
        """Records the end of a fault, if it was open."""
        with self._lock:
            entry = self._entries.get((device, kind))
            if entry is not None and entry.fault.open:
                lasted_s = entry.fault.lasted_s + at_s - entry.began_s
                self._change(entry, open=False, gone_at=at, lasted_s=lasted_s)

    def health(self, device: str) -> str:
        """Returns a short text with the device's faults; empty if there are none."""
        with self._lock:
            found = [entry for entry in self._entries.values() if entry.fault.open and entry.fault.device == device]
            return max(found, key=lambda entry: entry.number).fault.summary if found else ""

    def save(self) -> None:
        """Starts to write changes to disk, at most once a second; does not wait."""
        if self._clock() - self._saved_s >= _SAVE_EVERY_S:
            self._hand_over()

    def close(self) -> None:
        """Writes all changes to disk and closes the file. Idempotent."""
        if self._store is not None:
            for _ in range(2):  # the first pass may only have waited for an earlier write
                self._hand_over()
                wait([] if self._saving is None else [self._saving], _DISK_S)
            self._store.close()
            self._store = None

    # --- under the lock

    def _add(self, key: Key, found: DetectedFault, at: float, at_s: float, moments: Sequence[Moment]) -> None:
        samples = samples_of(moments, at_s)
        fault = Fault(
            id=self._new_id(),
            device=key[0],
            kind=found.kind,
            text=found.text,
            remedy=found.remedy,
            open=True,
            first_at=at,
            last_at=at,
            first=samples,
            latest=samples,
        )
        self._number += 1
        self._entries[key] = _Entry(fault, self._number, at_s)
        self._unsaved.add(key)
        if len(self._entries) > self._most:
            self._drop(min((each for each in self._entries if each != key), key=self._worth))

    def _worth(self, key: Key) -> tuple[bool, bool, int]:
        entry = self._entries[key]
        return entry.fault.open, not entry.fault.acknowledged_by, entry.number

    def _drop(self, key: Key) -> None:
        del self._entries[key]
        self._reported.pop(key, None)
        self._unsaved.add(key)

    def _begin_again(
        self, entry: _Entry, found: DetectedFault, at: float, at_s: float, moments: Sequence[Moment]
    ) -> None:
        self._number += 1
        entry.number, entry.began_s, entry.moments = self._number, at_s, tuple(moments)
        self._change(
            entry,
            open=True,
            text=found.text,
            remedy=found.remedy,
            last_at=at,
            gone_at=None,
            count=entry.fault.count + 1,
            latest=[],
            acknowledged_by="",
            acknowledged_at=None,
        )

    def _change(self, entry: _Entry, **changed: object) -> None:
        entry.fault = structs.replace(entry.fault, **changed)
        self._unsaved.add((entry.fault.device, entry.fault.kind))

    def _current(self, entry: _Entry) -> Fault:
        """Returns the fault with its current duration and samples."""
        if entry.moments:
            entry.fault = structs.replace(entry.fault, latest=samples_of(entry.moments, entry.began_s))
            entry.moments = ()
        fault = entry.fault
        lasted_s = fault.lasted_s + (self._clock() - entry.began_s if fault.open else 0.0)
        return structs.replace(fault, lasted_s=lasted_s)

    def _found(self, id: str, called: str) -> _Entry:  # noqa: A002
        for entry in self._entries.values():
            if entry.fault.id == id:
                return entry
        problem = f"there is no fault {id!r}; `trade faults` lists all faults"
        raise InvalidArgument(service=f"{self._robot}.faults.{called}", argument="id", problem=problem)

    def _new_id(self) -> str:
        """Returns a random id, so that ids on an unreadable disk are not used again."""
        known = {entry.fault.id for entry in self._entries.values()}
        while (made := f"{self._robot}-{secrets.token_hex(2)}") in known:
            pass
        return made

    # --- the disk

    def _hand_over(self) -> None:
        if self._store is None or (self._saving is not None and not self._saving.done()):
            return
        with self._lock:
            if self._saving is not None and not self._saving.result():
                self._unsaved |= self._sent
            self._saving, self._sent, self._unsaved = None, self._unsaved, set()
            kept: list[Kept] = [
                (self._entries[key].number, self._current(self._entries[key]))
                for key in self._sent
                if key in self._entries
            ]
            dropped = [key for key in self._sent if key not in self._entries]
        if self._sent:
            self._saved_s = self._clock()
            self._saving = self._store.save(kept, dropped)
