"""A simulated CiA 402 drive on the bench: no bus and no clock, frames by hand."""

from collections.abc import Callable

from trade_hil_sim import Frame, LogEntry
from trade_hil_sim.cia402 import Drive, Mode, State

NODE = 5
MODEL = "Simulated CiA 402 servo drive"
STATUS = 0x6F
SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET, HALT = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80, 0x100
NEW, AT_ONCE, RELATIVE = 0x10, 0x20, 0x40
REACHED, LIMITED, ACK = 0x400, 0x800, 0x1000


class Bench:
    """A drive of node id 5 and whatever it has said."""

    def __init__(self, position_counts: float = 0.0) -> None:
        self.t = 100.0
        self.sent: list[tuple[float, Frame]] = []
        self.log: list[LogEntry] = []
        self.drive = Drive(NODE, joint="leg.knee", model=MODEL, position_counts=position_counts, t=self.t)
        self.drive.send = lambda frame, t: self.sent.append((t, frame))
        self.drive.emit = self.log.append
        self.run(0.1)

    def run(self, s: float) -> None:
        """Let time pass."""
        end, rounds = self.t + s, 0
        while self.drive.due <= end:
            self.t = max(self.t, self.drive.due)
            self.drive.advance(self.t)
            rounds += 1
            assert rounds < 100_000, "it is due all the time"
        self.t = end
        self.drive.advance(end)

    def hear(self, can_id: int, data: bytes | str = b"") -> None:
        self.drive.hear(Frame(can_id, bytes.fromhex(data) if isinstance(data, str) else data), self.t)

    def frames(self, can_id: int | None = None) -> list[str]:
        """Data of what it has sent since it was last asked for everything, as hex."""
        return [f.data.hex() for _, f in self.sent if can_id in {None, f.can_id}]

    def times(self, can_id: int) -> list[float]:
        return [t for t, f in self.sent if f.can_id == can_id]

    def sdo(self, request: str) -> str:
        """One request, one answer, both hex."""
        self.hear(0x600 + NODE, request)
        [answer] = [(t, frame) for t, frame in self.sent if frame.can_id == 0x580 + NODE]
        self.sent.remove(answer)
        return answer[1].data.hex()

    def get(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        answer = bytes.fromhex(self.sdo((b"\x40" + index.to_bytes(2, "little") + bytes([sub, 0, 0, 0, 0])).hex()))
        assert answer[0] & 0xE3 == 0x43, f"no expedited answer: {answer.hex()}"
        length = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + length], "little", signed=signed)

    def put(self, index: int, value: int, size: int, sub: int = 0) -> None:
        answer = self.try_put(index, value, size, sub)
        assert answer == 0, f"refused with {answer:08x}"

    def try_put(self, index: int, value: int, size: int, sub: int = 0) -> int:
        """The abort code, or 0."""
        data = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little").ljust(4, b"\0")
        head = bytes([0x23 | 4 - size << 2]) + index.to_bytes(2, "little") + bytes([sub])
        answer = bytes.fromhex(self.sdo((head + data).hex()))
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    # the drive

    def control(self, word: int) -> int:
        """Write the controlword; returns the statusword."""
        self.put(0x6040, word, 2)
        return self.status

    @property
    def status(self) -> int:
        return self.get(0x6041)

    @property
    def state(self) -> State:
        return self.drive.state_now

    @property
    def position(self) -> int:
        return self.get(0x6064, signed=True)

    @property
    def velocity(self) -> int:
        return self.get(0x606C, signed=True)

    def enable(self, mode: Mode) -> None:
        self.put(0x6060, mode, 1)
        self.run(0.01)
        for word in (0x06, 0x07, 0x0F):
            self.control(word)
        assert self.state is State.OPERATION_ENABLED

    def names(self, kind: str = "event") -> list[str]:
        return [e.name for e in self.log if e.kind == kind]

    def until(self, true: Callable[[], bool], *, within_s: float, step_s: float = 0.001) -> float:
        """Seconds until something is true; it must be in time."""
        begun = self.t
        while not true():
            assert self.t - begun < within_s, "it did not happen"
            self.run(step_s)
        return self.t - begun


def enabled(mode: Mode, position: float = 0.0) -> Bench:
    """One that is on, in a mode."""
    bench = Bench(position)
    if mode is Mode.CYCLIC_POSITION:
        bench.put(0x607A, round(position), 4)
    bench.enable(mode)
    return bench


def move(bench: Bench, target: int, extra: int = 0) -> None:
    """The whole handshake of a set-point."""
    bench.put(0x607A, target, 4)
    assert bench.control(ENABLE | NEW | extra) & ACK
    assert not bench.control(ENABLE) & ACK
