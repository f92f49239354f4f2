"""A CANopen node (CiA 301): network management, heartbeats both ways, emergency messages, SDO and PDO. Pure."""

from enum import IntEnum
from math import inf
from typing import Final

from trade_hil_sim.can import Frame

from ._objects import Object
from ._pdo import Application, Pdos
from ._sdo import SdoServer
from ._store import Abort, AbortCode, Store

BOOT_S: Final = 0.05
"""From power or reset to the boot-up message."""
HEARTBEAT_LOST: Final = 0x8130
CONSUMERS: Final = (1, 2)
HISTORY: Final = 8
FIRST_PDO: Final = 0x1400
LAST_PDO: Final = 0x1BFF
PROFILE: Final = 0x6000
"""Objects with this index or a greater one belong to the drive."""
REGISTER_BITS: Final = {0x2: 0b10, 0x3: 0b100, 0x4: 0b1000, 0x81: 0b1_0000, 0x82: 0b1_0000, 0x8: 0b10_0000}
"""Bits of the error register, besides the generic one, by the first digits of an error code (CiA 301)."""


class NodeState(IntEnum):
    """States of network management, as a heartbeat reports them."""

    BOOTING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class Node:
    """The communication side of a device.

    Args:
        node_id: 1 to 127.
        store: the device's objects.
        application: the rest of the device.
        t: time of power-up, in seconds.
    """

    def __init__(self, node_id: int, store: Store, application: Application, t: float) -> None:
        self.node_id, self.state = node_id, NodeState.BOOTING
        self._store, self._app = store, application
        self._sdo, self._pdos = SdoServer(self), Pdos(store, application, self.emergency)
        self._served = frozenset({0x000, 0x600 + node_id})
        self._boots_at = inf
        self._beats_at = inf
        self._lost_at = dict[int, float]()
        self._missed = set[int]()
        self.reset(t)

    def map_only_pre_operational(self) -> None:
        """Refuse changes of PDOs while operational, as many drives do."""
        self._pdos.strict = True

    # time

    @property
    def due(self) -> float:
        """When `advance` should be called."""
        return min(self._boots_at, self._beats_at, self._pdos.due, *self._lost_at.values())

    def advance(self, t: float) -> None:
        """Run what is due."""
        if t >= self._boots_at:
            self._boot(t)
        if t >= self._beats_at:
            self._beat(t)
        for slot, lost_at in tuple(self._lost_at.items()):
            if t >= lost_at:
                self._miss(slot, t)
        self._pdos.advance(t)

    # what comes over the bus

    def accepts(self, can_id: int) -> bool:
        """Whether frames of this identifier may concern it: the acceptance filter of its controller."""
        return (
            can_id in self._pdos.heard
            or can_id in self._served
            or can_id == self._store.get("sync_cob_id") & 0x7FF
            or 0x700 < can_id <= 0x77F
        )

    def hear(self, frame: Frame, t: float) -> None:
        """Take a frame that concerns this node."""
        if self.state is NodeState.BOOTING or frame.extended or frame.remote:
            return
        if frame.can_id == 0x000:
            self._command(frame.data, t)
        elif 0x700 < frame.can_id <= 0x77F:
            self._hear_heartbeat(frame.can_id & 0x7F, t)
        elif self.state is not NodeState.STOPPED:
            self._hear_data(frame, t)

    def _hear_data(self, frame: Frame, t: float) -> None:
        if frame.can_id == 0x600 + self.node_id:
            answer = self._sdo.answer(frame.data, t)
            if answer is not None:
                self._app.put(Frame(0x580 + self.node_id, answer), t)
        elif frame.can_id == self._store.get("sync_cob_id") & 0x7FF:
            self._pdos.sync(t)
        else:
            self._pdos.hear(frame, t)

    def _command(self, data: bytes, t: float) -> None:
        if len(data) != 2 or data[1] not in {0, self.node_id}:
            return
        match data[0]:
            case 0x01:
                self.enter(NodeState.OPERATIONAL, t)
            case 0x02:
                self.enter(NodeState.STOPPED, t)
                self._app.link_lost("stopped by network management", t)
            case 0x80:
                self.enter(NodeState.PRE_OPERATIONAL, t)
            case 0x81:
                self._app.note("nmt_reset", t, "node")
                self.reset(t)
            case 0x82:
                self._app.note("nmt_reset", t, "communication")
                self.reset(t, power=False)
            case _:
                self._app.note("refused", t, f"network management command {data[0]:#04x}")

    def enter(self, state: NodeState, t: float) -> None:
        """Change the state of network management."""
        if state is self.state:
            return
        self.state = state
        self._app.note("nmt", t, state.name.lower())
        self._pdos.stop()
        if state is NodeState.OPERATIONAL:
            self._pdos.start(t)

    # power and heartbeats

    def reset(self, t: float, *, power: bool = True) -> None:
        """Reset all objects, and boot. Without `power` the drive's own objects are kept, but motion ends."""
        kept = {} if power else {o.name: self._store.get(o.name) for o in self._store.numbers if o.index >= PROFILE}
        self._store.reset()
        for name, value in kept.items():
            self._store.set(name, value)
        self._store.set("emcy_cob_id", 0x80 + self.node_id)
        self.state = NodeState.BOOTING
        self._pdos.stop()
        self._sdo.reset()
        self._boots_at, self._beats_at = t + BOOT_S, inf
        self._lost_at.clear()
        self._missed.clear()
        if power:
            self._app.power_on(t)
        else:
            self._app.link_lost("communication reset", t)

    def _boot(self, t: float) -> None:
        self._boots_at = inf
        self._app.put(Frame(0x700 + self.node_id, bytes([NodeState.BOOTING])), t)
        self._app.note("booted", t)
        self.enter(NodeState.PRE_OPERATIONAL, t)
        self._start_beating(t)

    def _start_beating(self, t: float) -> None:
        period_s = self._store.get("producer_heartbeat_ms") / 1e3
        self._beats_at = t + period_s if period_s else inf

    def _beat(self, t: float) -> None:
        self._app.put(Frame(0x700 + self.node_id, bytes([self.state])), t)
        self._start_beating(t)

    def _hear_heartbeat(self, node: int, t: float) -> None:
        """Monitor a heartbeat from its first message on (CiA 301, 7.2.8.3.2.2)."""
        for slot in CONSUMERS:
            setting = self._store.get(f"consumer_heartbeat_{slot}")
            if setting >> 16 & 0x7F == node and setting & 0xFFFF:
                self._lost_at[slot] = t + (setting & 0xFFFF) / 1e3
                if slot in self._missed:
                    self._missed.remove(slot)
                    self._app.link_back(t)

    def _miss(self, slot: int, t: float) -> None:
        del self._lost_at[slot]
        self._missed.add(slot)
        node = self._store.get(f"consumer_heartbeat_{slot}") >> 16 & 0x7F
        self._app.note("watchdog_expired", t, f"no heartbeat of node {node}")
        self.emergency(HEARTBEAT_LOST, t)
        self._app.link_lost(f"no heartbeat of node {node}", t)
        if self.state is NodeState.OPERATIONAL:
            after = (NodeState.PRE_OPERATIONAL, NodeState.OPERATIONAL, NodeState.STOPPED)
            self.enter(after[self._store.get("communication_error_behaviour")], t)

    # emergencies

    def emergency(self, code: int, t: float) -> None:
        """Report an error, and record it."""
        bits = REGISTER_BITS.get(code >> 8) or REGISTER_BITS.get(code >> 12) or 0b1000_0000
        self._store.set("error_register", self._store.get("error_register") | 1 | bits)
        recent = [code, *(self._store.get(f"error_history_{k}") for k in range(1, HISTORY))]
        for k, past in enumerate(recent, 1):
            self._store.set(f"error_history_{k}", past)
        self._store.set("error_history_count", min(HISTORY, self._store.get("error_history_count") + 1))
        self._tell(code, t)

    def emergency_over(self, t: float) -> None:
        """Report that no error is left."""
        if self._store.get("error_register"):
            self._store.set("error_register", 0)
            self._tell(0, t)

    def _tell(self, code: int, t: float) -> None:
        self._app.note("emcy", t, f"{code:04X}h")
        cob_id = self._store.get("emcy_cob_id")
        if self.state in {NodeState.OPERATIONAL, NodeState.PRE_OPERATIONAL} and not cob_id & 1 << 31:
            data = code.to_bytes(2, "little") + bytes([self._store.get("error_register")]) + bytes(5)
            self._app.put(Frame(cob_id & 0x7FF, data), t)

    def changed(self, t: float) -> None:
        """Send event-driven PDOs whose values may have changed."""
        self._pdos.changed(t)

    # the dictionary, as the SDO server wants it

    def read(self, index: int, sub: int, t: float) -> bytes:
        """The bytes of an object; raises `Abort`."""
        entry = self._store.find(index, sub)
        self._app.refresh(t)
        return self._store.read(entry)

    def write(self, index: int, sub: int, data: bytes, t: float) -> None:
        """Change an object; raises `Abort`."""
        entry = self._store.find(index, sub)
        value = self._store.check(entry, data)
        if index == 0x1010:
            raise Abort(AbortCode.CANNOT_STORE)
        if FIRST_PDO <= index <= LAST_PDO:
            self._pdos.check(entry, value)
        self._app.check(entry, value)
        if index < PROFILE:
            self._store.set(entry.name, value)
            self._configure(entry, t)
        self._app.written("sdo_write", [(entry, value)], t)

    def _configure(self, entry: Object, t: float) -> None:
        if FIRST_PDO <= entry.index <= LAST_PDO:
            self._pdos.reload(entry.index)
        elif entry.index == 0x1003:
            for k in range(1, HISTORY + 1):
                self._store.set(f"error_history_{k}", 0)
        elif entry.index == 0x1016:
            self._lost_at.pop(entry.sub, None)
            self._missed.discard(entry.sub)
        elif entry.index == 0x1017:
            self._start_beating(t)
