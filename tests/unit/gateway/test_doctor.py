"""What ``trade doctor`` finds, and the fix that comes with it."""

import json
import sys
from collections.abc import Iterable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.support.simulated_robots import HAND, HEAD, TAIL
from tests.unit.drivers.test_second_reader import HOLDS, other_program
from trade.transport.endpoints import free_endpoint
from trade_drivers import CanBus, ScannedDevice, parse
from trade_drivers.bus.can import ErrorState, Link
from trade_drivers.plugins._ports import SeenPorts
from trade_gateway.cli import app
from trade_gateway.cli.hardware import _doctor_host as host
from trade_gateway.cli.hardware import _doctor_robot as robots
from trade_gateway.cli.hardware._doctor import _of_robot
from trade_gateway.cli.hardware._doctor_host import Finding
from trade_gateway.cli.hardware._robot_file_template import first_file
from trade_gateway.pki._authority import Authority
from trade_hil_sim import Arm, DynamixelBus, Mute, Place, UrBus, motion_writes, received, writes

pytestmark = pytest.mark.virtual_time


def only(found: Iterable[Finding]) -> Finding:
    [one] = found
    assert one.level == "ok" or one.fix
    return one


@pytest.mark.real_clock
def test_a_port_that_may_not_be_opened_names_the_group_to_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    assert only(host.ports([str(port)])).level == "ok"
    monkeypatch.setattr("os.access", lambda *_: False)
    found = only(host.ports([str(port)]))
    assert (found.level, found.about) == ("error", str(port))
    assert "usermod -aG" in found.fix


def test_ports_that_the_system_does_not_list_are_not_said_to_be_missing() -> None:
    assert only(host.ports([])).text == "no adapter is plugged in"
    assert only(host.ports([], ["/x/neck", "/x/hand"])).text.endswith("the robot file names 2, checked below")


def test_an_uncalibrated_joint_is_reported_with_the_command_that_measures_it() -> None:
    text = first_file(
        [("/dev/ttyUSB0", ScannedDevice(driver="dynamixel", baud=57600, id=1, model="XL430-W250"))], Path("new.toml")
    )
    found = only(robots.unmeasured(parse(text, "new.toml"), Path("new.toml")))
    assert (found.level, found.about, found.fix) == ("warning", "joint1_1", "trade calibrate new.toml joint1_1")
    assert not list(robots.unmeasured(parse(HEAD, "head.toml"), Path("head.toml")))


@pytest.mark.parametrize(("ms", "level"), [(16, "warning"), (1, "ok")])
def test_an_adapter_with_a_long_latency_is_reported(tmp_path: Path, ms: int, level: str) -> None:
    timer = tmp_path / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir()
    timer.write_text(f"{ms}\n", encoding="ascii")
    found = only(host.latencies(tmp_path))
    assert (found.level, found.about) == (level, "ttyUSB0")
    assert str(timer) in found.fix or level == "ok"


@pytest.mark.parametrize(("needed", "level"), [(True, "error"), (False, "warning")])
def test_a_library_that_is_missing_is_named_with_what_installs_it(
    monkeypatch: pytest.MonkeyPatch, needed: bool, level: str
) -> None:
    assert only(host.libraries(["dynamixel"], needed=needed)).level == "ok"
    monkeypatch.setattr(
        "trade_drivers.plugins._driver.find_spec", lambda name: None if name == "dynamixel_sdk" else object()
    )
    found = only(host.libraries(["dynamixel"], needed=needed))
    assert (found.level, found.text) == (level, "needs dynamixel_sdk")
    assert found.fix == 'pip install "trade-drivers[dynamixel]"'


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("said", "level", "text"), [("yes", "ok", "is sync"), ("no", "warning", "is not"), ("", "warning", "it is unknown")]
)
def test_the_clock_is_synchronised_or_not_or_unknown(said: str, level: str, text: str) -> None:
    found = only(host.clock([sys.executable, "-c", f"print({said!r})"]))
    assert (found.level, found.text.startswith(text)) == (level, True)


@pytest.mark.realtime
def test_a_host_without_the_tool_does_not_know() -> None:
    assert only(host.clock(["/no/such/tool"])).text.startswith("it is unknown")


@pytest.mark.parametrize(("symbol", "level"), [(b"sem_clockwait", "ok"), (b"sem_timedwait", "warning")])
def test_a_python_whose_waits_follow_the_wall_clock_is_reported(tmp_path: Path, symbol: bytes, level: str) -> None:
    python, other, maps = tmp_path / "libpython3.11.so.1.0", tmp_path / "libc.so.6", tmp_path / "maps"
    python.write_bytes(b"\0sem_post\0" + symbol + b"\0")
    other.write_bytes(b"\0sem_clockwait\0")
    there = [f"7f00-7f{at}0 r-xp 0000 08:01 123    {path}" for at, path in enumerate((python, other, "[heap]"))]
    maps.write_text("\n".join([*there, "7f00-7f01 rw-p 0000 00:00 0"]))
    assert only(host.waits(maps)).level == level


@pytest.mark.parametrize(
    ("later", "level", "text"),
    [
        (timedelta(hours=1), "ok", "is valid until"),
        (timedelta(days=6), "warning", "expires on"),
        (timedelta(days=8), "error", "expired on"),
        (timedelta(days=-2), "error", "is valid only from"),
    ],
)
def test_a_certificate_is_reported_before_it_expires(tmp_path: Path, later: timedelta, level: str, text: str) -> None:
    issued = Authority.create(tmp_path / "pki").issue("arm")
    found = only(host.certificate(issued.folder, datetime.now(timezone.utc) + later))
    assert (found.level, found.text.startswith(text)) == (level, True), found


def test_a_certificate_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    assert only(host.certificate(tmp_path)).level == "error"


def test_devices_without_a_watchdog_are_named_and_those_with_one_are_not() -> None:
    found = only(robots.unwatched(parse(HAND, "hand.toml")))
    assert (found.level, "hand" in found.about) == ("warning", True)
    assert not list(robots.unwatched(parse(HEAD, "head.toml")))


LEGS = CanBus(name="legs", driver="cia402", interface="socketcan", channel="can0", bitrate=500_000)


@pytest.mark.parametrize(
    ("link", "level", "fix"),
    [
        (Link(False, None), "error", "ip link set can0 up type can bitrate 500000"),
        (Link(True, ErrorState.ACTIVE, 1_000_000), "error", "ip link set can0 down"),
        (Link(True, ErrorState.PASSIVE, 500_000), "error", "120 ohm"),
        (Link(True, ErrorState.ACTIVE, 500_000), "ok", ""),
        (Link(True, None), "ok", ""),
        (Link(True, ErrorState.ACTIVE, 500_000, 17), "warning", "ip link set can0 txqueuelen 128"),
        (Link(True, ErrorState.ACTIVE, 500_000, 18), "ok", ""),
    ],
)
def test_a_can_interface_is_up_at_the_rate_of_the_file_and_healthy(link: Link, level: str, fix: str) -> None:
    found = robots.judged(LEGS, link, 6)
    assert (found.level, fix in found.fix) == (level, True)


@pytest.fixture
def robot_file(tmp_path: Path) -> Path:
    path = tmp_path / "head.toml"
    path.write_text(HEAD.replace("/dev/ttyNOWHERE", str(tmp_path / "neck")), encoding="utf-8")
    return path


def simulated(robot_file: Path) -> DynamixelBus:
    robot = parse(robot_file.read_text(encoding="utf-8"), "head.toml")
    [bus] = robot.buses
    return DynamixelBus.from_robot(bus, robot.joints, robot_file.with_name("neck"), paced=False)  # type: ignore[arg-type]


def of_devices(robot_file: Path) -> list[Finding]:
    return list(robots.devices(parse(robot_file.read_text(encoding="utf-8"), "head.toml")))


def test_a_missing_port_is_reported(robot_file: Path) -> None:
    found = only(of_devices(robot_file))
    assert (found.level, found.about) == ("error", "bus neck")


def test_a_port_whose_number_may_change_is_named_with_a_lasting_name(tmp_path: Path) -> None:
    """Two equal adapters swap ttyUSB0 and ttyUSB1, and each robot's commands go to the other arm."""
    (tmp_path / "by-path").mkdir()
    lasting = tmp_path / "by-path" / "pci-0:usb-0:1.2"
    lasting.symlink_to("/dev/ttyUSB7")
    found = only(robots.numbered(parse(HEAD.replace("/dev/ttyNOWHERE", "/dev/ttyUSB7"), "head.toml"), tmp_path))
    assert (found.level, found.about) == ("warning", "bus neck")
    assert str(lasting) in found.fix
    assert not list(robots.numbered(parse(HEAD.replace("/dev/ttyNOWHERE", str(lasting)), "head.toml"), tmp_path))


def test_an_adapter_that_two_robot_files_name_is_an_error_with_both_files(robot_file: Path) -> None:
    other = robot_file.with_name("other.toml")
    other.write_text(robot_file.read_text().replace('"rosie"', '"ada"'))
    seen = SeenPorts()
    assert not [one for one in _of_robot(robot_file, seen) if one.about == "ports"]
    found = only([one for one in _of_robot(other, seen) if one.about == "ports"])
    assert found.level == "error"
    assert f"{other}: bus.neck.port" in found.text
    assert f"{robot_file}: bus.neck.port already" in found.text


@pytest.mark.realtime
def test_devices_that_answer_are_named(robot_file: Path) -> None:
    with simulated(robot_file):
        assert [found.level for found in of_devices(robot_file)] == ["ok", "ok"]


@pytest.mark.realtime
def test_a_device_that_does_not_answer_is_an_error(robot_file: Path) -> None:
    with simulated(robot_file) as sim:
        sim.devices[0].absent = True
        pan, tilt = of_devices(robot_file)
    assert (pan.level, pan.text, tilt.level) == ("error", "does not answer at 1000000 baud", "ok")


@pytest.mark.realtime
def test_a_device_that_answers_now_and_then_has_a_bad_line(robot_file: Path) -> None:
    with simulated(robot_file) as sim:
        sim.do(Mute(ids=(1,), instruction="ping", skip=3, count=2))
        pan, _ = of_devices(robot_file)
    assert (pan.level, pan.text) == ("error", "answered 8 of 10 requests correctly")
    assert "termination" in pan.fix


@pytest.mark.realtime
def test_another_device_than_the_file_says_is_an_error(robot_file: Path) -> None:
    with simulated(robot_file):
        text = robot_file.read_text(encoding="utf-8").replace("id = 1\n", 'id = 1\nfirmware = "44"\n')
        robot_file.write_text(text, encoding="utf-8")
        pan, tilt = of_devices(robot_file)
    assert (pan.level, tilt.level) == ("error", "ok")
    assert pan.text == "its firmware is 45, and the robot file says 44"


@pytest.mark.realtime
def test_a_line_in_use_is_left_alone(robot_file: Path) -> None:
    with simulated(robot_file) as sim:
        from trade_drivers.vendors.dynamixel import DynamixelDriver

        bench = DynamixelDriver.commissioner().open(str(sim.port), 1_000_000)
        try:
            found = only(of_devices(robot_file))
        finally:
            bench.close()
    assert (found.level, "another driver owns this port" in found.text) == ("warning", True)


@pytest.mark.realtime
def test_a_range_beyond_the_devices_setting_is_reported_as_by_trade_up(robot_file: Path) -> None:
    with simulated(robot_file) as sim:
        sim.devices[0].memory.set("max_position_limit", 2500)
        pan, tilt = of_devices(robot_file)
        assert not writes(list(sim.log.entries))
    assert (pan.level, tilt.level) == ("error", "ok")
    assert (
        'joint."neck.pan": min_rad -1.4 to max_rad 1.4 is more than the device\'s own range (registers 52' in pan.text
    )


@pytest.mark.realtime
def test_S23_a_joint_outside_the_devices_own_range_is_reported_with_both_angles(robot_file: Path) -> None:
    with simulated(robot_file) as sim:
        sim.devices[0].memory.set("max_position_limit", 3000)
        sim.do(Place(ids=(1,), counts=3100))
        pan, tilt = of_devices(robot_file)
        assert not writes(list(sim.log.entries))
    assert (pan.level, tilt.level) == ("error", "ok")
    assert "at 1.614 rad, outside its own range, which ends at 1.460 rad (register 48)" in pan.text


@pytest.mark.realtime
def test_another_program_that_reads_a_line_is_an_error_with_its_name_and_pid(robot_file: Path) -> None:
    with simulated(robot_file) as sim, other_program(str(sim.port), HOLDS) as pid:
        found = only(of_devices(robot_file))
        assert not received(list(sim.log.entries))
    assert found.level == "error"
    assert f"(pid {pid})" in found.text
    assert "ModemManager" in found.fix


def test_one_adapter_under_two_names_is_an_error_that_names_both_keys(tmp_path: Path) -> None:
    path, link = tmp_path / "two.toml", tmp_path / "by-id"
    link.symlink_to("/dev/null")
    text = HEAD.replace("/dev/ttyNOWHERE", "/dev/null")
    path.write_text(text + TAIL.split('"rosie"')[1].replace("/dev/ttyNOTAIL", str(link)))
    found = next(one for one in _of_robot(path) if one.level == "error")
    assert (found.level, found.about) == ("error", "ports")
    assert "bus.tail.port" in found.text and "bus.neck.port" in found.text and str(link) in found.text


@pytest.mark.real_clock
def test_a_port_that_is_no_line_is_an_error_that_names_file_and_key(robot_file: Path, tmp_path: Path) -> None:
    (tmp_path / "neck").write_text("a file\n")
    found = only(of_devices(robot_file))
    assert (found.level, "head.toml: bus.neck.port" in found.text) == ("error", True)
    assert "is not a serial port" in found.text and "end the program that uses it" not in found.fix


WRONG = TAIL.replace("feetech", "feetek") + HAND.replace("0.085", "85").split('"rosie"')[1] + HEAD.split('"rosie"')[1]


@pytest.mark.realtime
def test_a_file_that_drivers_refuse_is_reported_for_all_parts_and_ends_nothing(system: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(WRONG)
    said = CliRunner().invoke(app, ["doctor", str(path), "--json"])
    assert said.exit_code == 1
    errors = {one["about"]: one["text"] for one in json.loads(said.stdout) if one["level"] == "error"}
    assert errors.keys() == {"bus tail", "bus hand", "bus neck"}
    assert f"{path}: bus.tail.driver: there is no driver 'feetek'" in errors["bus tail"]
    assert f'{path}: gripper."left.hand".max_width_m: 85 is outside' in errors["bus hand"]


@pytest.mark.realtime
def test_the_exit_code_shows_errors(system: str, robot_file: Path) -> None:
    said = CliRunner().invoke(app, ["doctor", str(robot_file), "--json"])
    assert said.exit_code == 1
    found = json.loads(said.stdout)
    assert [one["about"] for one in found if one["level"] == "error"] == ["bus neck"]
    with simulated(robot_file):
        well = CliRunner().invoke(app, ["doctor", str(robot_file)])
    assert well.exit_code == 0, well.output
    assert "0 errors" in well.output


@pytest.mark.realtime
def test_an_endpoint_without_an_answer_is_an_error(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = free_endpoint()
    monkeypatch.setenv("TRADE_CONNECT", nowhere)
    said = CliRunner().invoke(app, ["doctor", "--json"])
    assert said.exit_code == 1
    [error] = [one for one in json.loads(said.stdout) if one["about"] == nowhere]
    assert error["level"] == "error"
    assert "nothing accepts connections there" in error["text"]
    assert "no container is visible" not in said.stdout


@pytest.mark.realtime
def test_a_client_with_bad_certificates_is_not_advised_to_connect_without(
    system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value, fix in (
        ("TRADE_TLS", str(tmp_path), "the message says what helps"),
        ("TRADE_CONNECT", "nonsense", "correct that variable, or leave it out"),
    ):
        with monkeypatch.context() as changed:
            changed.setenv(name, value)
            found = json.loads(CliRunner().invoke(app, ["doctor", "--json"]).stdout)
        [error] = [one for one in found if one["about"] == "settings"]
        assert error["fix"] == fix, error


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("text", "said"),
    [('system = "lab"', "trade gateway {} --check"), ('[system]\nname = "home"', "trade system up {} --check")],
)
def test_a_file_of_another_kind_is_refused_with_its_name(system: str, tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "some.toml"
    path.write_text(text)
    found = json.loads(CliRunner().invoke(app, ["doctor", str(path), "--json"]).stdout)
    [error] = [one for one in found if one["about"] == str(path)]
    assert error["fix"] == said.format(path)
    assert "robot file" in error["text"] and "unknown table" not in error["text"]


@pytest.mark.parametrize("text", ["[robot", "[robot]\nname = 3\n"], ids=["no TOML", "a wrong key"])
def test_a_file_that_is_wrong_is_named_once(tmp_path: Path, text: str) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(text, encoding="utf-8")
    [finding] = _of_robot(wrong)
    assert finding.about == str(wrong)
    assert str(wrong) not in finding.text


ARM = (Path(__file__).parents[3] / "examples" / "arm.toml").read_text()
SERVICES = {
    "dashboard": "has no dashboard server (port 29999)",
    "rtde": "has no RTDE (port 30004)",
    "script": "has no script port (port 30003)",
}


@pytest.mark.realtime
@pytest.mark.parametrize("lacks", [(), ("dashboard",), ("rtde",), ("script",), ("rtde", "script")])
def test_each_service_of_an_arm_that_trade_up_needs_is_checked(lacks: tuple[str, ...]) -> None:
    with UrBus(Arm(name="right"), name="ur", lacks=lacks) as sim:
        found = list(robots.controllers(parse(ARM.replace("192.168.0.10", str(sim.port)), "arm.toml")))
        assert not motion_writes(sim.log.entries)
        assert not [entry for entry in sim.log.entries if entry.name in {"upload", "stop"}]
    assert [one.level for one in found] == (["error"] * len(lacks) or ["ok"])
    assert {one.about for one in found} == {str(sim.port)}
    assert all(one.text.startswith(SERVICES[name]) for one, name in zip(found, lacks, strict=False))
    assert all("Settings, Security, Services" in one.fix for one in found if lacks)
    assert [one for one in found if "PolyScope X" in one.fix] == (found if lacks == ("dashboard",) else [])


@pytest.mark.realtime
def test_an_arm_without_any_service_is_one_finding() -> None:
    with UrBus(Arm(name="right"), name="ur", lacks=tuple(SERVICES)) as sim:
        found = only(robots.controllers(parse(ARM.replace("192.168.0.10", str(sim.port)), "arm.toml")))
    assert (found.level, found.text.partition(":")[0]) == ("error", "cannot be reached")
