"""The control socket: commands in, the truth out, and errors that say what would be right."""

import inspect
import json
import socket
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from trade_hil_sim import Command, DynamixelBus, Late, Servo, SimControl, SimulationError
from trade_hil_sim.control._server import ControlServer
from trade_hil_sim.faults._commands import kinds_of
from trade_hil_sim.faults._methods import FaultMethods

pytestmark = pytest.mark.realtime

KINDS: Final = kinds_of(Command)
FIELDS: Final[dict[str, Any]] = {
    "bus": "neck",
    "ids": (1, 2),
    "instruction": "read",
    "skip": 2,
    "count": 3,
    "s": 0.5,
    "missing": 4,
    "hex": "00",
    "on": False,
    "kind": "rtde",
    "nth": 2,
    "tick": True,
    "number": 7,
    "bits": 4,
    "code": 0x2310,
    "lasting": True,
    "voltage_v": 11.0,
    "temperature_c": 70,
    "counts": 100,
    "width_m": 0.02,
    "stiffness_n_m": 900.0,
    "inside": True,
    "zero": "turn",
}
"""A value for each field that a fault has, other than what it is without."""


@pytest.fixture
def path() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as directory:  # tmp_path may be too long for a socket
        yield Path(directory) / "control"


@pytest.fixture
def buses(make_bus: Any) -> list[DynamixelBus]:
    return [make_bus(1, Servo(2, joint="neck.tilt"), name="neck"), make_bus(3, name="arm")]


@pytest.fixture
def server(path: Path, buses: list[DynamixelBus]) -> Iterator[ControlServer]:
    with ControlServer(path, buses) as server:
        yield server


@pytest.fixture
def control(server: ControlServer) -> Iterator[SimControl]:
    with SimControl(server.path) as control:
        yield control


def say(server: ControlServer, line: str) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(10)
        client.connect(str(server.path))
        client.sendall(line.encode() + b"\n")
        return json.loads(client.makefile().readline())


def test_it_closes_also_if_its_last_client_woke_it_up_before_the_bell(path: Path, buses: list[DynamixelBus]) -> None:
    server = ControlServer(path, buses).open()
    assert say(server, '{"do": "state"}')["ok"]
    thread = server._thread
    assert thread is not None
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(server.path))
        server._closing = True
    thread.join(20)
    server.close()
    assert not path.exists()
    assert server._wake_write.fileno() == -1


def test_state_is_the_truth_about_every_device(control: SimControl, buses: list[DynamixelBus]) -> None:
    neck, arm = control.state()
    assert (neck.name, neck.port, neck.plugged) == ("neck", str(buses[0].port), True)
    assert [d.device_id for d in [*neck.devices, *arm.devices]] == [1, 2, 3]
    tilt = control.device("neck.tilt")
    assert (tilt.bus, tilt.device_id, tilt.position_counts, tilt.torque, tilt.moving) == ("neck", 2, 2048, False, False)
    with pytest.raises(SimulationError, match=r"0 devices are called 9; there is .*neck.tilt"):
        control.device(9)


def test_commands_reach_the_bus_they_name(control: SimControl, buses: list[DynamixelBus]) -> None:
    control.unplug("neck")
    assert [bus.plugged for bus in control.state()] == [False, True]
    control.replug("neck")
    assert [bus.plugged for bus in control.state()] == [True, True]
    control.place(1234, [3])
    assert control.device(3).position_counts == 1234


def test_ids_are_looked_up_on_every_bus_unless_one_is_named(control: SimControl) -> None:
    control.place(100, [2, 3])
    assert [control.device(k).position_counts for k in (1, 2, 3)] == [2048, 100, 100]
    with pytest.raises(SimulationError, match=r"no bus has a device \[9\]; there is \[1, 2\] on neck, \[3\] on arm"):
        control.mute([9])
    with pytest.raises(SimulationError, match=r"bus arm has no device \[1\]; it has \[3\]"):
        control.mute([1], bus="arm")
    with pytest.raises(SimulationError, match=r"there is no bus 'leg'; there is neck, arm"):
        control.unplug("leg")


class Listener(FaultMethods):
    """Records its commands."""

    def __init__(self) -> None:
        self.done: list[Command] = []

    def do(self, command: Command) -> None:
        self.done.append(command)


@pytest.mark.parametrize("word", KINDS)
def test_each_fault_is_a_method_that_takes_its_fields(word: str) -> None:
    kind, listener = KINDS[word], Listener()
    given = {name: FIELDS[name] for name in kind.__struct_fields__}
    method = getattr(listener, word)
    assert inspect.signature(method).parameters.keys() == given.keys()
    method(**given)
    assert listener.done == [kind(**given)]


def test_what_is_left_out_is_as_in_the_value() -> None:
    listener = Listener()
    for word in KINDS.keys() - {"late", "dribble", "hang_up", "emergency", "wrong_model", "place"}:
        getattr(listener, word)()
        assert listener.done.pop() == KINDS[word]()


def test_faults_reach_the_simulator_by_their_methods(control: SimControl) -> None:
    control.mute([1], instruction="read", count=1)
    control.unmute()
    control.late(0.01, [1], count=1)
    control.bad_crc(count=1)
    control.hardware_fault(0x20, [1])
    control.freeze([1])
    control.jam([1], bus="neck")
    control.absent([1])
    assert (control.device(1).absent, control.device(1).hardware_error) == (True, 0x20)
    control.heal()
    control.brown_out([1])
    control.do(Late(s=1.0, bus="neck"))
    assert control.device(1).absent is False


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ('{"do": "dance"}', "do is one of state, absent, bad_crc"),
        ("{}", "do is one of"),
        ("hello", 'a command is one line such as {"do": "mute"'),
        ('{"do": "late"}', "`s`; its keys are do, bus, ids, instruction, skip, count, s"),
        ('{"do": "mute", "id": 1}', "unknown field `id`; its keys are do, bus, ids"),
        ('{"do": "late", "s": -1}', ">= 0"),
        ('{"do": "garbage", "hex": "xyz"}', "hex"),
    ],
)
def test_a_wrong_command_is_answered_with_what_would_be_right(server: ControlServer, line: str, hint: str) -> None:
    assert hint in say(server, line)["error"]


def test_plain_json_is_enough(server: ControlServer, buses: list[DynamixelBus]) -> None:
    assert say(server, '{"do": "mute", "ids": [1]}') == {"ok": True}
    assert say(server, '{"do": "state"}')["buses"][1]["devices"][0]["device_id"] == 3


def test_several_clients_are_served_at_once(server: ControlServer) -> None:
    clients = [SimControl(server.path) for _ in range(5)]
    threads = [threading.Thread(target=lambda c=c: [c.state() for _ in range(20)]) for c in clients]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for client in clients:
        client.close()
    assert say(server, '{"do": "state"}')["ok"]


def test_a_client_without_a_simulator_says_where_it_looked(path: Path) -> None:
    with pytest.raises(SimulationError, match=f"no simulator listens on {path}"):
        SimControl(path)


def test_a_simulator_that_goes_away_is_an_error(path: Path, buses: list[DynamixelBus]) -> None:
    with ControlServer(path, buses) as server:
        control = SimControl(server.path)
        control.state()
    with pytest.raises(SimulationError, match="the simulator is gone"):
        control.state()
    control.close()


def test_the_socket_goes_with_the_server_and_a_stale_one_is_replaced(path: Path, buses: list[DynamixelBus]) -> None:
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
    assert path.is_socket()
    with ControlServer(path, buses):
        with pytest.raises(SimulationError, match="is another simulator using it"):
            ControlServer(path, buses).open()
        with SimControl(path) as control:
            assert len(control.state()) == 2
    assert not path.exists()


def test_a_path_too_long_for_a_socket_is_refused_with_advice(tmp_path: Path, buses: list[DynamixelBus]) -> None:
    with pytest.raises(SimulationError, match="give a shorter path"):
        ControlServer(tmp_path / ("x" * 120), buses).open()
