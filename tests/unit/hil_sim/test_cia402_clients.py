"""Other people's clients on the simulated drives: canopen as master, plain python-can, cantools as decoder."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import canopen
import cantools
import pytest
from canopen import objectdictionary as od
from canopen.profiles.p402 import BaseNode402

from tests.support.waiting import wait_until
from trade_hil_sim import (
    Absent,
    BrownOut,
    Emergency,
    Frame,
    Heal,
    Mute,
    SimControl,
    SimProcess,
    SimulationError,
    events,
    frames,
    motion_writes,
    writes,
)
from trade_hil_sim.cia402 import OBJECTS, Cia402Bus, Drive, pdo_objects

pytestmark = pytest.mark.virtual_time

KINDS = {"u8": 5, "i8": 2, "u16": 6, "i16": 3, "u32": 7, "i32": 4, "text": 9}
LEG = """
[robot]
name = "rosie"

[bus.leg]
driver = "cia402"
interface = "socketcan"
channel = "can0"
bitrate = 1_000_000

[joint."leg.hip"]
bus = "leg"
id = 4
model = "CiA402"
counts_per_rev = 4000
gear = 50
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 5.0

[joint."leg.knee"]
bus = "leg"
id = 5
model = "CiA402"
counts_per_rev = 4096
reversed = true
offset_rad = 0.5
min_rad = 1.0
max_rad = 2.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 5.0
"""


@pytest.fixture
def make_drives() -> Iterator[Callable[..., Cia402Bus]]:
    opened: list[Cia402Bus] = []

    def make(*ids: int, paced: bool = False) -> Cia402Bus:
        drives = [Drive(i, joint=f"leg.{i}", model="Knee drive, long name", t=time.monotonic()) for i in ids]
        bus = Cia402Bus(drives, name="leg", paced=paced)
        bus.open()
        opened.append(bus)
        wait_until(lambda: len(events(bus.log.entries, "booted")) == len(ids), "the drives are up")
        return bus

    yield make
    for bus in opened:
        bus.close()


@pytest.fixture
def connect() -> Iterator[Callable[[str], can.BusABC]]:
    opened: list[can.BusABC] = []

    def connect_(port: str) -> can.BusABC:
        interface, _, rest = port.partition(":")
        address, _, channel = rest.partition("/")
        host, _, number = address.partition(":")
        opened.append(can.Bus(interface=interface, channel=channel, host=host, port=int(number), tcp_tune=True))
        return opened[-1]

    yield connect_
    for client in opened:
        client.shutdown()


def dictionary(node: int) -> od.ObjectDictionary:
    """Ours, in the words of canopen."""
    made = od.ObjectDictionary()
    made.node_id = node
    records: dict[int, Any] = {}
    subs = {entry.index for entry in [*OBJECTS, *pdo_objects(node)] if entry.sub}
    for entry in [*OBJECTS, *pdo_objects(node)]:
        variable = od.ODVariable(entry.name, entry.index, entry.sub)
        variable.data_type, variable.access_type = KINDS[entry.kind], entry.access
        variable.pdo_mappable = bool(entry.mapped)
        if entry.index not in subs:
            made.add_object(variable)
            continue
        if entry.index not in records:
            records[entry.index] = od.ODRecord(entry.name, entry.index)
            made.add_object(records[entry.index])
        records[entry.index].add_member(variable)
    return made


@pytest.fixture
def open_master(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """The library canopen as master: a network and its nodes."""
    # its own dials for slow drives: simulator and client share two cores and one interpreter here
    for name in ("TIMEOUT_SWITCH_STATE_FINAL", "TIMEOUT_SWITCH_STATE_SINGLE", "TIMEOUT_CHECK_TPDO"):
        monkeypatch.setattr(BaseNode402, name, 10.0)
    opened: list[canopen.Network] = []

    def open_(bus: can.BusABC, *ids: int) -> SimpleNamespace:
        network = canopen.Network(bus)
        network.NOTIFIER_CYCLE = 0.05
        network.connect()
        opened.append(network)
        nodes = [network.add_node(BaseNode402(i, dictionary(i))) for i in ids]
        for node in nodes:
            node.sdo.RESPONSE_TIMEOUT = 10.0
        return SimpleNamespace(network=network, nodes=nodes)

    yield open_
    for network in opened:
        network.notifier.stop(timeout=10)


def configure(node: Any) -> None:
    """TPDO1: statusword, mode, position; RPDO1: controlword, target."""
    node.nmt.state = "PRE-OPERATIONAL"
    node.tpdo.read()
    node.rpdo.read()
    for pdo, entries in ((node.tpdo[1], (0x6041, 0x6061, 0x6064)), (node.rpdo[1], (0x6040, 0x607A))):
        pdo.clear()
        for entry in entries:
            pdo.add_variable(entry)
        pdo.trans_type, pdo.enabled = 255, True
    node.tpdo[1].event_timer = 50
    node.tpdo.save()
    node.rpdo.save()
    node.setup_402_state_machine(read_pdos=False)
    node.nmt.state = "OPERATIONAL"
    assert node.tpdo[1].wait_for_reception(10) is not None


# canopen


def test_canopen_reads_names_numbers_and_refusals(make_drives: Any, connect: Any, open_master: Any) -> None:
    master = open_master(connect(make_drives(5).port), 5)
    [node] = master.nodes
    assert node.sdo["device_name"].raw == "Knee drive, long name"
    assert node.sdo["device_type"].raw == 0x20192
    assert node.sdo["identity_count"]["product_code"].raw == 402
    node.sdo["target_position"].raw = -123456
    assert node.sdo["target_position"].raw == -123456
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo["statusword"].raw = 1
    assert refused.value.code == 0x0601_0002


def test_canopen_enables_a_drive_moves_it_and_receives_its_faults(
    make_drives: Any, connect: Any, open_master: Any
) -> None:
    bus = make_drives(5)
    master = open_master(connect(bus.port), 5)
    [node] = master.nodes
    configure(node)
    node.op_mode = "PROFILED POSITION"
    wait_until(lambda: node.sdo["mode_display"].raw == 1, "the mode")
    node.state = "OPERATION ENABLED"
    assert bus.state().devices[0].torque
    node.sdo["target_position"].raw = 2000
    node.sdo["controlword"].raw = 0x1F
    assert node.sdo["statusword"].raw & 0x1000
    wait_until(lambda: node.tpdo[1]["position_actual"].raw == 2000, "the arrival")
    bus.do(Emergency(code=0x2310))
    wait_until(lambda: node.state == "FAULT", "the fault")
    wait_until(lambda: node.emcy.active, "the emergency")
    assert node.emcy.active[0].code == 0x2310
    node.sdo["controlword"].raw = 0
    node.sdo["controlword"].raw = 0x80
    wait_until(lambda: node.state == "SWITCH ON DISABLED", "the reset")
    controls = [e.data.hex() for e in writes(bus.log.entries, device_id=5, register="controlword") if e.moves]
    assert controls[0].startswith("06")
    assert [e.name for e in events(bus.log.entries, device_id=5) if e.name.startswith("torque")] == [
        "torque_on",
        "torque_off",
    ]


def test_canopen_hears_heartbeats_and_a_reboot(make_drives: Any, connect: Any, open_master: Any) -> None:
    bus = make_drives(4, 5)
    master = open_master(connect(bus.port), 4, 5)
    for node in master.nodes:
        node.sdo["producer_heartbeat_ms"].raw = 20
        assert node.nmt.wait_for_heartbeat(10) == "PRE-OPERATIONAL"
    beats: list[int] = []
    master.nodes[1].nmt.add_heartbeat_callback(beats.append)
    bus.do(BrownOut(ids=(5,)))
    wait_until(lambda: 0 in beats, "the boot-up")
    assert len(frames(bus.log.entries, "boot_up", device_id=5)) == 2


def test_six_drives_answer_a_train_of_syncs(make_drives: Any, connect: Any, open_master: Any) -> None:
    ids = (1, 2, 3, 4, 5, 6)
    bus = make_drives(*ids, paced=True)
    master = open_master(connect(bus.port), *ids)
    for node in master.nodes:
        node.sdo["tpdo1_settings"]["tpdo1_type"].raw = 1
    master.network.nmt.state = "OPERATIONAL"
    for _ in range(20):
        before = len(frames(bus.log.entries, "tpdo1"))
        master.network.sync.transmit()
        wait_until(lambda before=before: len(frames(bus.log.entries, "tpdo1")) == before + 6, "six answers")
    syncs = [e.t for e in frames(bus.log.entries, "sync")]
    for begun, after in zip(syncs, [*syncs[1:], float("inf")], strict=True):
        answers = frames(bus.log.entries, "tpdo1", since=begun, until=after)
        assert [e.device_id for e in answers] == list(ids)  # the lowest id goes first
        assert answers[-1].t - begun == pytest.approx(sum(Frame(e.can_id or 0, e.data).bits for e in answers) / 1e6)


# plain python-can and cantools


def take(client: can.BusABC, can_id: int, count: int = 1) -> list[can.Message]:
    got: list[can.Message] = []

    def enough() -> bool:
        heard = client.recv(0.05)
        if heard is not None and heard.arbitration_id == can_id:
            got.append(heard)
        return len(got) == count

    wait_until(enough, f"{count} frames {can_id:03X}")
    return got


def say(client: can.BusABC, can_id: int, data: str) -> None:
    client.send(can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=False))


def test_frames_written_by_hand_bring_a_drive_up_and_cantools_reads_what_it_says(
    make_drives: Any, connect: Any
) -> None:
    database = cantools.database.load_file(Path(__file__).with_name("drives.dbc"))
    bus = make_drives(5)
    client = connect(bus.port)
    script = [
        "2f60600001000000",  # mode 1
        "2300180185010080",  # TPDO1 off
        "2f001a0000000000",
        "23001a0110004160",
        "23001a0208006160",
        "23001a0320006460",
        "2f001a0003000000",
        "2300180185010000",  # and on
        "2300140105020080",
        "2f00160000000000",
        "2300160110004060",
        "2300160220007a60",
        "2f00160002000000",
        "2300140105020000",
        "2b17100032000000",  # heartbeat 50 ms
    ]
    for request in script:
        say(client, 0x605, request)
        assert take(client, 0x585)[0].data[0] == 0x60
    beat = database.decode_message(0x705, take(client, 0x705)[0].data)
    assert beat == {"State": "pre_operational"}
    say(client, 0x000, "0105")
    for control in (0x06, 0x07, 0x0F, 0x1F):
        target = database.encode_message("KNEE_RPDO1", {"Control": control, "Target": 1.5})
        client.send(can.Message(arbitration_id=0x205, data=target, is_extended_id=False))
    say(client, 0x605, "2b00180514000000")  # every 20 ms
    reported: list[Any] = []

    def arrived() -> bool:
        reported.append(database.decode_message(0x185, take(client, 0x185)[0].data))
        return bool(reported[-1]["Reached"]) and reported[-1]["Position"] == 1.5

    wait_until(arrived, "the arrival")
    assert (reported[-1]["Enabled"], reported[-1]["Fault"], reported[-1]["Mode"]) == (1, 0, 1)
    moves = motion_writes(bus.log.entries, device_id=5)
    assert [e.data[:2].hex() for e in moves if e.name == "rpdo1"] == ["0600", "0700", "0f00", "1f00"]
    assert frames(bus.log.entries, "rpdo1", source="client1", direction="in", device_id=5)


# bad days: what is done to the bus, and what a client sees of the drive's heartbeat


@pytest.mark.parametrize(
    "fault",
    [Mute(ids=(5,)), Mute(ids=(5,), instruction="heartbeat"), Absent(ids=(5,))],
    ids=["silent", "heartbeat lost", "unplugged"],
)
def test_a_heartbeat_that_is_lost_comes_back_and_the_other_drive_never_notices(
    make_drives: Any, connect: Any, fault: Any
) -> None:
    bus = make_drives(4, 5)
    client = connect(bus.port)
    for node in (4, 5):
        say(client, 0x600 + node, "2b17100014000000")
        take(client, 0x580 + node)
    take(client, 0x705, 2)
    bus.do(fault)
    lost_at = time.monotonic()
    take(client, 0x704, 10)
    assert frames(bus.log.entries, "heartbeat", device_id=5, since=lost_at) == []
    bus.do(Heal())
    take(client, 0x705, 2)


# the robot file, in a process of its own


@pytest.fixture
def leg(tmp_path: Path) -> Path:
    path = tmp_path / "leg.toml"
    path.write_text(LEG)
    return path


@pytest.mark.realtime
def test_a_robot_file_with_a_can_bus_is_simulated_in_a_process(leg: Path, connect: Any) -> None:
    with SimProcess(leg) as sim:
        port = sim.ports["leg"]
        assert port.startswith("socketcand:127.0.0.1:")
        assert port.endswith("/can0")
        one, other = connect(port), connect(port)
        wait_until(lambda: len(events(sim.entries(), "booted")) == 2, "the drives are up")
        say(one, 0x605, "4064600000000000")
        answer = take(one, 0x585)[0].data
        # the nearest to zero it may be is 1 rad: half a radian from its own zero, turned the other way
        assert int.from_bytes(answer[4:], "little", signed=True) == -round(0.5 / 6.283185307 * 4096)
        take(other, 0x585)
        knee, hip = sim.control.device("leg.knee"), sim.control.device("leg.hip")
        assert (knee.position_rad, hip.position_rad) == (pytest.approx(1.0, abs=1e-3), 0.0)
        assert [(e.name, e.source, e.direction) for e in frames(sim.entries(), device_id=5)][-2:] == [
            ("sdo_request", "client1", "in"),
            ("sdo_reply", "leg.knee", "out"),
        ]
        with SimControl(sim.control_path) as control:
            control.absent([5])
            assert control.device(5).absent
            control.heal()
            control.do(Emergency(code=0x2310, ids=(5,)))
            assert control.device(5).hardware_error == 0x2310


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (("counts_per_rev = 4096\n", ""), r'joint."leg.knee".counts_per_rev: missing'),
        (("id = 5", "id = 200"), r'joint."leg.knee".id: 200 is no node id'),
        (('interface = "socketcan"\nchannel = "can0"\nbitrate = 1_000_000', 'port = "/dev/tty9"'), "interface and ch"),
    ],
)
def test_a_robot_file_it_cannot_simulate_is_refused_with_the_key(leg: Path, change: Any, hint: str) -> None:
    leg.write_text(LEG.replace(*change))
    with pytest.raises(SimulationError, match=hint):
        SimProcess(leg)
