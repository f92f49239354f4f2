"""Process data objects: which values travel in which frames, and when (CiA 301, 7.2.2). Pure: time is an argument."""

import struct
from collections.abc import Callable, Sequence
from math import inf
from typing import Final, Protocol

from trade_hil_sim.can import Frame

from ._objects import DUMMIES, ENTRIES, PDOS, Object
from ._store import Abort, AbortCode, Store

FIRST_OBJECT: Final = 0x1000
"""Lower indices are data types, which a map may name to skip bytes."""
FIRST_SENT: Final = 0x1800
"""Objects of transmit PDOs begin here; those of receive PDOs come before."""
NUMBER: Final = 0x1FF
"""The part of an index that gives the PDO's number."""
INVALID: Final = 1 << 31
LAST_SYNC_TYPE: Final = 240
EVENT_TYPES: Final = (254, 255)
MOST_BITS: Final = 64
INHIBIT_S: Final = 1e-4
TOO_SHORT: Final = 0x8210
TOO_LONG: Final = 0x8220
FORMATS: Final = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i"}


class Application(Protocol):
    """The device, as its communication side uses it."""

    def refresh(self, t: float) -> None:
        """Bring measured values up to date."""
        ...

    def check(self, entry: Object, value: int) -> None:
        """Raise `Abort` if this must not be written."""
        ...

    def written(self, name: str, values: Sequence[tuple[Object, int]], t: float) -> None:
        """Apply what has been written, by ``sdo_write`` or ``rpdo1`` and so on, all at once."""
        ...

    def link_lost(self, reason: str, t: float) -> None:
        """React to the loss of the master: the abort connection option applies."""
        ...

    def link_back(self, t: float) -> None:
        """React to the return of a missed heartbeat."""
        ...

    def power_on(self, t: float) -> None:
        """Start again; the store has its defaults."""
        ...

    def put(self, frame: Frame, t: float) -> None:
        """Send a frame."""
        ...

    def note(self, name: str, t: float, detail: str = "") -> None:
        """Put an event into the log."""
        ...


class _Pdo:
    """One PDO as its objects say."""

    def __init__(self, store: Store, kind: str, number: int) -> None:
        name = f"{kind}pdo{number}"
        self.name = name
        cob_id = store.get(f"{name}_cob_id")
        self.valid, self.can_id = not cob_id & INVALID, cob_id & 0x7FF
        self.type = store.get(f"{name}_type")
        self.inhibit_s = store.get(f"{name}_inhibit_100us") * INHIBIT_S
        self.event_s = store.get(f"{name}_event_ms") / 1e3
        count = store.get(f"{name}_count")
        self.carries = [_mapped(store, kind, store.get(f"{name}_entry_{k}")) for k in range(1, count + 1)]
        self.layout = struct.Struct("<" + "".join(FORMATS[entry.kind] for entry in self.carries))
        self.names = tuple(entry.name for entry in self.carries)
        self.events = tuple(entry.name for entry in self.carries if not entry.measured)
        self.sent_at = -inf
        self.last: tuple[int, ...] | None = None
        """Values sent last that are not measured."""
        self.waits = False
        """Whether to send it when the inhibit time is over."""
        self.syncs = 0
        self.held: bytes | None = None
        """Received, and to take effect at the next SYNC."""

    @property
    def synchronous(self) -> bool:
        return self.type <= LAST_SYNC_TYPE

    @property
    def due(self) -> float:
        if not self.valid or self.synchronous:
            return inf
        if self.waits:
            return self.sent_at + self.inhibit_s
        return self.sent_at + max(self.event_s, self.inhibit_s) if self.event_s else inf


class Pdos:
    """The PDOs of one device.

    An event is a change of a mapped value that does not change continuously: of the statusword, for example, but not
    of the position. Continuous values are sent by the event timer or at SYNC.

    Args:
        store: the device's objects.
        application: what the values come from and go to.
        complain: reports an error that is no fault, by an emergency message.
    """

    def __init__(self, store: Store, application: Application, complain: Callable[[int, float], None]) -> None:
        self._store, self._app, self._complain = store, application, complain
        self.running = False
        self.strict = False
        """Whether its objects can be changed only while the node is pre-operational, as CiA 301 permits."""
        self._load()

    def _load(self) -> None:
        self._received = [_Pdo(self._store, "r", k) for k in range(1, PDOS + 1)]
        self._sent = [_Pdo(self._store, "t", k) for k in range(1, PDOS + 1)]
        self._tune()

    def _tune(self) -> None:
        self.heard = frozenset(pdo.can_id for pdo in self._received if pdo.valid)
        """Identifiers of the PDOs it receives."""

    def reload(self, index: int) -> None:
        """An object of a PDO has been written: that PDO restarts."""
        kind, pdos = ("r", self._received) if index < FIRST_SENT else ("t", self._sent)
        number = index & NUMBER
        pdos[number] = _Pdo(self._store, kind, number + 1)
        self._tune()

    def start(self, t: float) -> None:
        """The node is operational: event-driven PDOs are sent once."""
        self._load()
        self.running = True
        self.changed(t)

    def stop(self) -> None:
        """The node is not operational any more."""
        self.running = False

    @property
    def due(self) -> float:
        """When `advance` should be called."""
        return min((pdo.due for pdo in self._sent), default=inf) if self.running else inf

    def advance(self, t: float) -> None:
        """Send what is due."""
        for pdo in self._sent:
            if self.running and pdo.due <= t:
                self._send(pdo, t)

    def hear(self, frame: Frame, t: float) -> bool:
        """Take a frame if it is one of these PDOs; return whether it is."""
        for pdo in self._received:
            if self.running and pdo.valid and pdo.can_id == frame.can_id:
                self._hear(pdo, frame.data, t)
                return True
        return False

    def sync(self, t: float) -> None:
        """The moment of SYNC: measured values are sampled, then set-points received before take effect."""
        if not self.running:
            return
        for pdo in self._sent:
            if pdo.valid and pdo.synchronous:
                self._sync(pdo, t)
        for pdo in self._received:
            if pdo.held is not None:
                held, pdo.held = pdo.held, None
                self._apply(pdo, held, t)

    def changed(self, t: float) -> None:
        """Send the PDOs whose values may have changed."""
        for pdo in self._sent:
            if self.running and pdo.valid and not pdo.synchronous and self._events(pdo) != pdo.last:
                if t < pdo.sent_at + pdo.inhibit_s:
                    pdo.waits = True
                else:
                    self._send(pdo, t)

    # SDO writes to PDO objects

    def check(self, entry: Object, value: int) -> None:
        """Refuse invalid writes to a PDO's objects; raises `Abort`."""
        if self.strict and self.running:
            raise Abort(AbortCode.DEVICE_STATE)
        index, kind, number = entry.index, "r" if entry.index < FIRST_SENT else "t", entry.index & NUMBER
        name = f"{kind}pdo{number + 1}"
        valid = not self._store.get(f"{name}_cob_id") & INVALID
        if index & 0x200:
            self._check_mapping(name, kind, entry, value, valid)
        elif entry.sub == 1 and valid and not value & INVALID and value != self._store.get(entry.name):
            raise Abort(AbortCode.DEVICE_STATE)
        elif entry.sub == 2 and value > LAST_SYNC_TYPE and value not in EVENT_TYPES:
            raise Abort(AbortCode.VALUE)
        elif entry.sub == 3 and valid:
            raise Abort(AbortCode.DEVICE_STATE)

    def _check_mapping(self, name: str, kind: str, entry: Object, value: int, valid: bool) -> None:
        """A map is changed while the PDO is invalid, its entries while their count is 0."""
        if valid or (entry.sub > 0 and self._store.get(f"{name}_count")):
            raise Abort(AbortCode.DEVICE_STATE)
        if entry.sub > 0:
            if value:
                _mapped(self._store, kind, value)
            return
        values = [self._store.get(f"{name}_entry_{k}") for k in range(1, min(value, ENTRIES) + 1)]
        if sum(8 * _mapped(self._store, kind, value).size for value in values) > MOST_BITS:
            raise Abort(AbortCode.PDO_TOO_LONG)

    # inside

    def _hear(self, pdo: _Pdo, data: bytes, t: float) -> None:
        if len(data) < pdo.layout.size:
            self._complain(TOO_SHORT, t)
            return
        if len(data) > pdo.layout.size:
            self._complain(TOO_LONG, t)
        if pdo.synchronous:
            pdo.held = data
        else:
            self._apply(pdo, data, t)

    def _apply(self, pdo: _Pdo, data: bytes, t: float) -> None:
        values = zip(pdo.carries, pdo.layout.unpack_from(data), strict=True)
        self._app.written(pdo.name, [(entry, value) for entry, value in values if entry.index >= FIRST_OBJECT], t)

    def _sync(self, pdo: _Pdo, t: float) -> None:
        pdo.syncs += 1
        if pdo.type == 0:
            self._app.refresh(t)
            if self._values(pdo) != pdo.last:
                self._send(pdo, t)
        elif pdo.syncs >= pdo.type:
            pdo.syncs = 0
            self._send(pdo, t)

    def _send(self, pdo: _Pdo, t: float) -> None:
        self._app.refresh(t)
        pdo.sent_at, pdo.waits = t, False
        values = self._values(pdo)
        pdo.last = values if pdo.synchronous else self._events(pdo)
        self._app.put(Frame(pdo.can_id, pdo.layout.pack(*values)), t)

    def _values(self, pdo: _Pdo) -> tuple[int, ...]:
        return tuple(map(self._store.get, pdo.names))

    def _events(self, pdo: _Pdo) -> tuple[int, ...]:
        return tuple(map(self._store.get, pdo.events))


def _mapped(store: Store, kind: str, value: int) -> Object:
    """The object that a map's entry names; raises `Abort` if a PDO of this kind cannot carry it."""
    index, sub, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
    dummy = next((entry for entry in DUMMIES if (entry.index, entry.sub) == (index, sub)), None)
    entry = store.find(index, sub) if dummy is None else dummy
    if kind not in entry.mapped or bits != 8 * entry.size:
        raise Abort(AbortCode.NOT_MAPPABLE)
    return entry
