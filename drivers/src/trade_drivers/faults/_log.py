"""The one owner of what is known of a robot's faults; what anybody may ask of it are services."""

import secrets
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Annotated, Final

from msgspec import Struct, structs

from trade import Meta, current_call, service
from trade.errors import InvalidArgument
from trade_drivers.faults._record import Fault, FaultInfo, Moment, info_of, samples_of
from trade_drivers.faults._store import FaultStore, Kept, Key
from trade_drivers.faults._trouble import Found

__all__ = ["FaultLog"]

_MOST: Final = 200
"""So many kinds are kept; then those go first that are gone and acknowledged, the oldest of them first."""
_SAVE_EVERY_S: Final = 1.0
_AGAIN_S: Final = 5.0
"""What was open when the process before ended, and is found within so long, is the same and not another time."""
_DISK_S: Final = 10.0
_MOST_EVIDENCE: Final = 16

Id = Annotated[str, Meta(description="of a fault, as faults() tells it: rosie-3f2a")]
Note = Annotated[str, Meta(min_length=1, max_length=500, description="what was found out, and where it can be seen")]


class _Entry(Struct):
    """What is known of one fault while the process runs."""

    fault: Fault
    number: int
    """Which began later has the greater one, whatever the clock on the wall says."""
    began_s: float = 0.0
    """When it began the latest time, by the monotonic clock of this process."""
    moments: tuple[Moment, ...] = ()
    """What was measured then, as long as nobody asked for the numbers."""


class FaultLog:
    """Faults of the devices of one robot. To acknowledge one clears nothing in a device and moves nothing.

    Args:
        robot: its name.
        store: where they outlive the process; None: nowhere.
        clock: ``time.monotonic``.
        wall: ``time.time``.
        most: how many kinds are kept.
    """

    def __init__(
        self,
        robot: str,
        store: FaultStore | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
        most: int = _MOST,
    ) -> None:
        self._robot, self._store, self._clock, self._wall, self._most = robot, store, clock, wall, most
        self._lock = threading.Lock()
        self._entries: dict[Key, _Entry] = {}
        self._before: set[Key] = set()
        """Those that were open when the process before ended, and were not found since."""
        self._number = 0
        self._unsaved: set[Key] = set()
        self._sent: set[Key] = set()
        """Those that the disk has been given, and may have refused."""
        self._saving: Future[bool] | None = None
        self._saved_s = -_SAVE_EVERY_S
        self._started_s = clock()
        for number, fault in store.load() if store is not None else ():
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
        """All kinds of faults that were noticed, those that began last first; with ``open_only`` what is wrong now."""
        with self._lock:
            entries = sorted(self._entries.values(), key=lambda entry: -entry.number)
            return [info_of(self._told(entry)) for entry in entries if entry.fault.open or not open_only]

    @service(effect="read")
    def fault(self, id: Id) -> Fault:  # noqa: A002 - as it is called everywhere
        """One fault, with what its device measured before it began, the first time and the latest.

        Raises:
            InvalidArgument: there is none of that id.
        """
        with self._lock:
            return self._told(self._found(id, "fault"))

    @service(effect="note")
    def acknowledge(self, id: Id) -> FaultInfo:  # noqa: A002
        """Say that its caller has seen it. It stays until its cause is gone; if it begins again, it is unseen again.

        Raises:
            InvalidArgument: there is none of that id.
        """
        call = current_call()
        by = "its own process" if call is None else call.asker
        with self._lock:
            entry = self._found(id, "acknowledge")
            self._change(entry, acknowledged_by=by, acknowledged_at=self._wall())
            return info_of(self._told(entry))

    @service(effect="note")
    def add_evidence(self, id: Id, note: Note) -> FaultInfo:  # noqa: A002
        """Add what somebody found out about it, such as where a picture of it is; the newest 16 are kept.

        Raises:
            InvalidArgument: there is none of that id.
        """
        with self._lock:
            entry = self._found(id, "add_evidence")
            self._change(entry, evidence=[*entry.fault.evidence, note][-_MOST_EVIDENCE:])
            return info_of(self._told(entry))

    # --- for whoever notices

    def begin(self, device: str, found: Found, at: float, at_s: float, moments: Sequence[Moment] = ()) -> None:
        """Something is wrong from now on that was not before.

        Args:
            device: its name.
            found: what is wrong with it.
            at: seconds since the epoch.
            at_s: the same moment by the monotonic clock.
            moments: what the device measured before, oldest first.
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

    def end(self, device: str, kind: str, at: float, at_s: float) -> None:
        """It is gone; of what was not there, nothing is noted."""
        with self._lock:
            entry = self._entries.get((device, kind))
            if entry is not None and entry.fault.open:
                lasted_s = entry.fault.lasted_s + at_s - entry.began_s
                self._change(entry, open=False, gone_at=at, lasted_s=lasted_s)

    def health(self, device: str) -> str:
        """What is wrong with a device, in few words; empty if nothing is."""
        with self._lock:
            found = [entry for entry in self._entries.values() if entry.fault.open and entry.fault.device == device]
            return max(found, key=lambda entry: entry.number).fault.said if found else ""

    def save(self) -> None:
        """Have the disk take what has changed, at most once a second; waits for nothing."""
        if self._clock() - self._saved_s >= _SAVE_EVERY_S:
            self._hand_over()

    def close(self) -> None:
        """Have the disk take all there is, and let go of it; more than once is fine."""
        if self._store is not None:
            for _ in range(2):  # the first may only have waited for what was under way
                self._hand_over()
                wait([] if self._saving is None else [self._saving], _DISK_S)
            self._store.close()
            self._store = None

    # --- under the lock

    def _add(self, key: Key, found: Found, at: float, at_s: float, moments: Sequence[Moment]) -> None:
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
        self._unsaved.add(key)

    def _begin_again(self, entry: _Entry, found: Found, at: float, at_s: float, moments: Sequence[Moment]) -> None:
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

    def _told(self, entry: _Entry) -> Fault:
        """As it is now."""
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
        problem = f"there is no fault {id!r}; `trade faults` lists those there are"
        raise InvalidArgument(service=f"{self._robot}.faults.{called}", argument="id", problem=problem)

    def _new_id(self) -> str:
        """By chance: if the disk could not be read, those it holds are not given out again."""
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
                (self._entries[key].number, self._told(self._entries[key]))
                for key in self._sent
                if key in self._entries
            ]
            dropped = [key for key in self._sent if key not in self._entries]
        if self._sent:
            self._saved_s = self._clock()
            self._saving = self._store.save(kept, dropped)
