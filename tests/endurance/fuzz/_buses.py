"""What devices say to drivers, and what drivers say to simulated devices."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from msgspec.structs import replace
from pymodbus.framer import FramerRTU

from tests.endurance.fuzz._target import Target
from trade.errors import DeviceError
from trade_drivers import parse
from trade_drivers.bus.can._netlink import parse_link
from trade_drivers.vendors.cia402 import _wire as wire
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.dynamixel import _wire as dynamixel
from trade_drivers.vendors.feetech import _wire as feetech
from trade_drivers.vendors.odrive._axis import OdriveAxis
from trade_drivers.vendors.robotiq._wire import _QuietClient as ModbusClient
from trade_drivers.vendors.snapshot._picture import picture
from trade_drivers.vendors.ur import _dashboard as dashboard
from trade_hil_sim import SimulationError, UrBus
from trade_hil_sim.can._device import Device
from trade_hil_sim.can._frame import Frame
from trade_hil_sim.can._interface import LAYOUT
from trade_hil_sim.can._interface import _frame as frame_of
from trade_hil_sim.can._text import Reader, frame_text, parse_send
from trade_hil_sim.cia402 import Drive
from trade_hil_sim.control import _server as control
from trade_hil_sim.damiao import Motor
from trade_hil_sim.dynamixel import DynamixelBus
from trade_hil_sim.dynamixel import _protocol as dynamixel_sim
from trade_hil_sim.feetech import FeetechBus
from trade_hil_sim.feetech import _protocol as feetech_sim
from trade_hil_sim.odrive import Axis
from trade_hil_sim.robotiq import RobotiqBus
from trade_hil_sim.robotiq import _protocol as robotiq_sim
from trade_hil_sim.ur._dashboard import lines_in

EXAMPLES: Final = Path(__file__).parents[3] / "examples"
STEP_S: Final = 0.01


def _robot(name: str) -> Any:
    return parse((EXAMPLES / name).read_text(encoding="utf-8"), name)


def _until_empty(take: Callable[[bytearray], object], corrupt: type[Exception]) -> Callable[[bytes], int]:
    """Take packets until there is none left; every one makes what is held shorter."""

    def read(data: bytes) -> int:
        held, found = bytearray(data), 0
        while True:
            before = len(held)
            try:
                if take(held) is None:
                    return found
            except corrupt:
                pass
            assert len(held) < before
            found += 1

    return read


def _dynamixel_status(held: bytearray) -> bytes | None:
    frame = dynamixel.take_status(held)
    return None if frame is None else dynamixel.unstuffed(frame)


def _modbus(data: bytes) -> bytes | None:
    """The first byte says how many registers were asked for."""
    line = SimpleNamespace(received=bytearray(data[1:]), is_open=True, more=lambda: False)
    client = ModbusClient(line, "/dev/null", 115_200)  # type: ignore[arg-type]
    client.expect(9, 4, 1 + (data[0] if data else 0) % 4)
    frame = client.recv(None)
    assert not frame or FramerRTU.compute_CRC(frame[:-2]) == int.from_bytes(frame[-2:], "big")
    return frame


_LEG: Final = _robot("legs.toml").joints[0]
_TAIL: Final = _robot("tail.toml").joints[0]
_WRIST: Final = replace(_TAIL, model="DM4310")


def _sdo_answers(data: bytes) -> bytes:
    """A drive that says these eight bytes again and again, one after the other, while it is asked."""
    frames = [data[at : at + 8] for at in range(0, len(data), 8)] or [b""]
    transfer = wire.upload(0x1008, 0)
    request = next(transfer)
    try:
        for turn in range(10_000):
            frame = frames[turn % len(frames)]
            if request.is_answered_by(frame):
                request = transfer.send(frame)
            elif turn >= len(frames):
                return b""  # a drive that says nothing else is given up for its silence
    except StopIteration as ended:
        return bytes(ended.value)
    raise AssertionError("a drive that keeps answering is asked without end")


def _pieces(data: bytes) -> Iterator[bytes]:
    """A length and so many bytes, again and again."""
    at = 0
    while at < len(data):
        size = data[at] % 9
        yield data[at + 1 : at + 1 + size]
        at += 1 + size


def _cia402_axis(data: bytes) -> DriveAxis:
    axis = DriveAxis("rosie.leg", "can0", _LEG, 100.0)
    for number, piece in enumerate(_pieces(data), 1):
        axis.asked_ns = number
        axis.silent = bool(number % 5 == 0)
        for take in (lambda frame: axis.take_status(frame, 0), axis.take_motion, axis.take_emergency):
            take(piece)
        axis.take_heartbeat(piece, number)
    return axis


def _odrive_axis(data: bytes) -> Any:
    axis = OdriveAxis("rosie.tail", "can0", _TAIL, 100.0)
    takers = list(axis.listeners(lambda: 1).values())
    for number, piece in enumerate(_pieces(data)):
        axis.silent, axis.asked_ns = False, 1
        takers[number % len(takers)](piece)
    axis.state(2, 10)
    return axis


def _damiao_axis(data: bytes) -> Any:
    axis = DamiaoAxis("rosie.wrist", "can0", _WRIST, 100.0)
    for number, piece in enumerate(_pieces(data), 1):
        axis.silent, axis.asked_ns = False, number
        axis.take(piece, number)
    axis.state(2, 10)
    return axis


class _Connection:
    """A controller's dashboard that says these bytes, a few at a time, and hangs up."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def settimeout(self, timeout_s: float) -> None: ...

    def recv(self, most: int) -> bytes:
        reported, self._data = self._data[: min(most, 7)], self._data[min(most, 7) :]
        return reported


def _dashboard_line(data: bytes) -> str:
    return dashboard._line(_Connection(data), 1e9)  # type: ignore[arg-type]


def _packets(reader: Callable[[], Any]) -> Callable[[bytes], Any]:
    """The same packets however the bytes are torn, except for what is only noise."""

    def read(data: bytes) -> Any:
        whole = reader().feed(data)
        torn = reader()
        found = [packet for at in range(0, len(data), 3) for packet in torn.feed(data[at : at + 3])]
        assert found == whole
        return whole

    return read


def _encoded(encode: Callable[..., bytes]) -> Callable[[Any], bytes]:
    return lambda packets: b"".join(
        encode(p.device_id, p.instruction, p.params) for p in packets if getattr(p, "intact", True)
    )


def _requests(data: bytes) -> list[Any]:
    """As they are found in a stream, with a silence between pieces."""
    reader, found = robotiq_sim.RequestReader(), list[Any]()
    for at in range(0, len(data), 11):
        found += reader.feed(data[at : at + 11])
        reader.silence(0.01)
    return found


def _line(kind: type[Any], file: str, driver: str) -> Callable[[bytes], Any]:
    """A simulated line, not open: what comes in is carried out, and answers go nowhere."""
    robot = _robot(file)
    bus = next(bus for bus in robot.buses if bus.driver == driver)

    def read(data: bytes) -> Any:
        devices = [*robot.joints_on(bus.name), *robot.grippers_on(bus.name)]
        made = kind.from_robot(bus, devices, Path("/nowhere"), paced=False)
        for number, at in enumerate(range(0, len(data), 64)):
            made.received(data[at : at + 64], 1000.0 + number * STEP_S)
        return made.state()

    return read


_IDS: Final = (0x000, 0x080, 0x081, 0x201, 0x301, 0x401, 0x501, 0x601, 0x701, 0x77F, 0x7FF, 0x001, 0x101, 0x00C)


def _can(make: Callable[[], Device]) -> Callable[[bytes], Any]:
    """Frames: where in the identifiers, how many bytes, these, and time passes."""

    def read(data: bytes) -> Any:
        device, t, at = make(), 0.0, 0
        device.send, device.emit = (lambda frame, at: None), (lambda entry: None)
        while at + 2 <= len(data):
            head, size = data[at], data[at + 1] % 9
            can_id = _IDS[head % len(_IDS)] if head < 128 else (1 << 5 | head & 0x1F)
            device.hear(Frame(can_id, data[at + 2 : at + 2 + size], remote=data[at + 1] >= 250), t)
            t += STEP_S
            if device.due <= t:
                device.advance(t)
            at += 2 + size
        return device.state(t)

    return read


def _ur_rtde(data: bytes) -> Any:
    """A client of the controller's RTDE port; the first byte has a program run or not."""
    bus = UrBus()
    bus.arm.t = 0.0
    if data[:1] > b"\x7f":
        bus._program.upload("def rtde_control()\nend\n")
    session = bus._rtde.joined(lambda packet, name: packet.encode())
    held = bytearray()
    for at in range(1, len(data), 97):
        held += data[at : at + 97]
        bus._rtde.received(session, held)
        for _ in range(3):
            bus.arm.advance(0.002)
            bus._program.cycle()
            bus._rtde.cycle()
    return bus._state()


def _ur_dashboard(data: bytes) -> list[str]:
    bus = UrBus()
    held = bytearray(data)
    return [bus._dashboard.answer(line) for line in lines_in(held)]


def _can_text(data: bytes) -> list[Frame]:
    reader = Reader()
    commands = [words for at in range(0, len(data), 50) for words in reader.feed(data[at : at + 50])]
    assert len(reader._held) <= 256
    return [parse_send(words[1:]) for words in commands if words[:1] == ["send"]]


def _can_sent(frames: list[Frame]) -> bytes:
    return b"".join(
        f"< send {f.can_id:{'08X' if f.extended else '03X'}} {f.length if f.remote else len(f.data):X} "
        f"{f.data.hex(' ')} >".encode()
        for f in frames
    )


def _can_interface(data: bytes) -> list[bytes]:
    cut = (data[at : at + LAYOUT.size] for at in range(0, len(data) - LAYOUT.size + 1, LAYOUT.size))
    frames = [frame_of(*LAYOUT.unpack(one)) for one in cut]
    return [frame_text(frame, 0.0) for frame in frames if frame.bits]


def _control(data: bytes) -> Any:
    server = control.ControlServer.__new__(control.ControlServer)
    bus = DynamixelBus.from_robot(*_HEAD, Path("/nowhere"), paced=False)
    server.__init__(Path("/nowhere"), [bus])  # type: ignore[misc]
    return server.answer(data)


_FILE: Final = _robot("head.toml")
_HEAD: Final = (_FILE.buses[0], _FILE.joints_on(_FILE.buses[0].name))

TARGETS: Final = [
    Target("dynamixel-status", _until_empty(_dynamixel_status, dynamixel.Corrupt)),
    Target(
        "feetech-status", _until_empty(lambda held: feetech.take_status(held, range(1, 9), 2, b""), feetech.Corrupt)
    ),
    Target("modbus-answer", _modbus),
    Target("cia402-sdo", _sdo_answers, (wire.Aborted,)),
    Target("cia402-axis", _cia402_axis),
    Target("odrive-axis", _odrive_axis, (DeviceError,)),
    Target("damiao-axis", _damiao_axis, (DeviceError,)),
    Target("ur-dashboard-line", _dashboard_line, (OSError,)),
    Target("netlink", parse_link, (OSError,)),
    Target("picture", picture, (ValueError,)),
    Target("sim-dynamixel-packets", _packets(dynamixel_sim.PacketReader), (), _encoded(dynamixel_sim.encode)),
    Target("sim-feetech-packets", _packets(feetech_sim.PacketReader), (), _encoded(feetech_sim.encode)),
    Target("sim-modbus-requests", _requests),
    Target("sim-dynamixel", _line(DynamixelBus, "head.toml", "dynamixel")),
    Target("sim-feetech", _line(FeetechBus, "servo_arm.toml", "feetech")),
    Target("sim-robotiq", _line(RobotiqBus, "hand.toml", "robotiq")),
    Target("sim-cia402", _can(lambda: Drive(1))),
    Target("sim-odrive", _can(lambda: Axis(1))),
    Target("sim-damiao", _can(lambda: Motor(1))),
    Target("sim-ur-rtde", _ur_rtde, (ValueError,)),
    Target("sim-ur-dashboard", _ur_dashboard),
    Target("sim-can-text", _can_text, (SimulationError,), _can_sent),
    Target("sim-can-interface", _can_interface),
    Target("sim-control", _control),
]
