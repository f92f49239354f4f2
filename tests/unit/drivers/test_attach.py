"""Attaching: every mistake of wiring, setting and installation is named with what would be right."""

import time
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

import trade_hil_sim as sim
from tests.support.fake_container import fake_container
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig
from trade import Container
from trade.errors import ConfigurationError, DeviceFault
from trade_drivers import Driver, drivers, load
from trade_drivers.plugins import _driver as driver_module
from trade_hil_sim import DynamixelBus, Servo

pytestmark = pytest.mark.virtual_time


def refused(rig: Rig, **options: Any) -> str:
    with pytest.raises(ConfigurationError) as error:
        rig.attach(**options)
    assert not rig.announced
    return str(error.value)


def settings(**registers: int) -> Callable[[DynamixelBus], None]:
    """Servo 1 with other settings than it was shipped with."""

    def prepare(bus: DynamixelBus) -> None:
        for name, value in registers.items():
            bus.devices[0].memory.set(name, value)

    return prepare


def test_an_unknown_model_is_named_by_its_number(head: Rig) -> None:
    head.sim.do(sim.WrongModel(ids=(1,), number=4711))
    assert "model number 4711" in refused(head)


def test_an_answer_that_comes_twice_is_found_out(head: Rig) -> None:
    head.sim.do(sim.Duplicate(ids=(1,), instruction="ping"))
    assert "two devices may share this id" in refused(head)


@pytest.mark.parametrize("instruction", ["ping", "read", None])
def test_a_device_has_as_long_to_answer_at_first_as_its_measurements_may_be_old(
    rig: Rig, instruction: str | None
) -> None:
    rig.configure(('port = "/dev/ttyNOWHERE"', 'port = "/dev/ttyNOWHERE"\nstale_after_s = 2\nwatchdog_s = 2'))
    rig.plug().do(sim.Mute(ids=(1,), instruction=instruction, count=5))
    assert rig.attach().motor("neck.pan").state().name == "rosie.neck.pan"


def test_a_port_that_is_not_there_is_named(head: Rig) -> None:
    text = refused(head, ports={"neck": "/dev/ttyNOWHERE"})
    assert "head.toml: bus.neck.port" in text
    assert "/dev/ttyNOWHERE" in text


@pytest.mark.realtime
@pytest.mark.parametrize("kind", ["file", "folder", "device"])
def test_a_path_that_is_no_serial_port_is_named_with_its_key(head: Rig, tmp_path: Path, kind: str) -> None:
    (tmp_path / "file").touch()
    port = {"file": tmp_path / "file", "folder": tmp_path, "device": Path("/dev/null")}[kind]
    text = refused(head, ports={"neck": str(port)})
    assert text == f"head.toml: bus.neck.port: {port}: is not a serial port; `ls -l /dev/serial/by-id` lists the ports"


def test_the_port_of_the_file_is_used_unless_another_is_given(head: Rig) -> None:
    assert "/dev/ttyNOWHERE" in refused(head, ports={})


def test_a_port_for_a_bus_that_is_not_in_the_file_is_refused(head: Rig) -> None:
    assert "there is no bus 'arm'" in refused(head, ports={"arm": "/dev/null"})


@pytest.mark.parametrize(
    ("registers", "remedy"),
    [
        ({"operating_mode": 1}, "operating mode (register 11) is 1; set it to 3"),
        ({"operating_mode": 4}, "operating mode (register 11) is 4; set it to 3"),
        ({"drive_mode": 4}, "drive mode (register 10) is 4; set it to 0"),
        ({"drive_mode": 9}, "drive mode (register 10) is 9; set it to 0"),
        ({"drive_mode": 1}, "counts in the other direction by itself, and the file has reversed = "),
        ({"shadow_id": 2}, "obeys what is sent to id 2 (register 12)"),
        ({"status_return_level": 0}, "status return level (68)"),
        ({"status_return_level": 1}, "status return level (register 68) is 1; set it to 2"),
        ({"min_position_limit": 2000}, "registers 52 and 48"),
        ({"max_position_limit": 2100}, "registers 52 and 48"),
        ({"velocity_limit": 50}, "max_speed_rad_s: 2.5 is above the device's own limit 1.199 (register 44)"),
    ],
    ids=str,
)
def test_a_setting_that_the_driver_cannot_use_is_named_with_the_right_one(
    rig: Rig, registers: dict[str, int], remedy: str
) -> None:
    rig.plug(prepare=settings(**registers))
    text = refused(rig)
    assert 'head.toml: joint."neck.pan"' in text
    assert remedy in text
    assert not sim.writes(rig.log)


def test_a_hardware_error_does_not_keep_the_others_from_being_attached(rig: Rig) -> None:
    rig.plug(prepare=lambda bus: bus.devices[0].fail(0x20, time.monotonic()))
    robot = rig.attach()
    assert "overload" in robot.motor("neck.pan").state().fault
    robot.motor("neck.tilt").move_to(0.1)


def test_a_servo_on_a_can_bus_is_refused(head: Rig) -> None:
    head.configure(('port = "/dev/ttyNOWHERE"', 'interface = "virtual"\nchannel = "neck"'))
    assert "bus.neck: driver dynamixel needs a serial bus" in refused(head)


def test_a_gear_is_refused_where_it_would_be_ignored(head: Rig) -> None:
    head.configure(("reversed = true", "gear = 2"))
    assert 'joint."neck.tilt": counts_per_rev and gear are for other devices' in refused(head)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            ('driver = "dynamixel"', 'driver = "dynamixle"'),
            "there is no driver 'dynamixle'; installed: cia402, damiao, dynamixel, ",
        ),
        (("XL430-W250", "AX-12A"), "'AX-12A' is unknown to the driver dynamixel; it supports XL430-W250, XC430-W150, "),
        (('driver = "dynamixel"', 'driver = "dynamixel"\nrate_hz = 5'), "rate_hz: 5 is too slow"),
        (('driver = "dynamixel"', 'driver = "dynamixel"\nbaud = 57600\nrate_hz = 200'), "at most"),
        (
            ('driver = "dynamixel"', 'driver = "dynamixel"\nbaud = 1234567'),
            "head.toml: bus.neck.baud: 1234567 is no rate of these servos; they know 9600, 57600, ",
        ),
        (("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 1.0"), "a stop from max_speed_rad_s takes 2.5 s"),
        (("max_speed_rad_s = 2.5", "max_speed_rad_s = 0.01"), "is below 0.024, the least"),
        (("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 0.1"), "is below 0.375, the least"),
    ],
    ids=lambda value: value[1][-20:] if isinstance(value, tuple) else "",
)
def test_a_file_that_cannot_work_is_refused_before_a_byte_is_sent(
    rig: Rig, change: tuple[str, str], complaint: str
) -> None:
    rig.plug()
    rig.configure(change)
    assert complaint in refused(rig)
    assert not sim.received(rig.log)


def test_a_group_over_two_buses_is_a_provider_like_any_other(rig: Rig) -> None:
    rig.configure(
        (
            '[joint."neck.pan"]\nbus = "neck"',
            '[bus.arm]\ndriver = "dynamixel"\nport = "/dev/a"\n[joint."neck.pan"]\nbus = "arm"',
        )
    )
    rig.plug(Servo(1), Servo(2))
    other = DynamixelBus([Servo(1)], rig.sim.port.with_name("arm"), paced=False)
    with other:
        robot = rig.attach(ports={"neck": str(rig.sim.port), "arm": str(other.port)})
        assert rig.announced == [("rosie.neck.pan",), ("rosie.neck.tilt",), ("rosie.head",), ("rosie.faults",)]
        assert robot.group("head").joints() == ["rosie.neck.pan", "rosie.neck.tilt"]
        assert robot.motor("neck.pan").members["rosie.head"] == ["rosie.neck.pan", "rosie.neck.tilt"]
        robot.close()


def test_the_installed_drivers_are_listed_by_name() -> None:
    assert "dynamixel" in drivers()
    assert issubclass(drivers()["dynamixel"][0].load(), Driver)


def test_two_drivers_of_one_name_are_both_named(head: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [EntryPoint("dynamixel", f"{name}:Driver", "trade.drivers") for name in ("mine", "yours")]
    monkeypatch.setattr(driver_module, "entry_points", lambda group: points)
    assert "two drivers are named 'dynamixel': mine:Driver and yours:Driver" in refused(head)


def test_a_driver_that_cannot_be_imported_or_is_none_is_refused(head: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    for value, complaint in (("no_such_module:Driver", "cannot be imported"), ("json:dumps", "not a subclass")):
        points = [EntryPoint("dynamixel", value, "trade.drivers")]
        monkeypatch.setattr(driver_module, "entry_points", lambda group, points=points: points)
        assert complaint in refused(head)


def test_close_withdraws_what_was_announced_and_can_be_repeated(head: Rig) -> None:
    from trade_drivers import attach

    announced: list[object] = []
    robot = attach(
        head.robot,
        fake_container(register=lambda provider, groups: announced.append(provider), deregister=announced.remove),
        ports={"neck": str(head.sim.port)},
    )
    assert len(announced) == 4  # two joints, their group, and what reports faults
    closing = [Outcome(robot.close) for _ in range(3)]
    assert [outcome.wait().error for outcome in closing] == [None] * 3
    assert not announced


def test_a_container_that_is_closed_leaves_a_silent_bus(head: Rig, start_container: Callable[..., Container]) -> None:
    from trade_drivers import attach

    def quiet() -> bool:
        before = len(head.log)
        time.sleep(0.3)
        return len(head.log) == before

    driver = start_container("driver")
    robot = attach(head.robot, driver, ports=head.ports)
    assert not quiet()
    driver.close()
    wait_until(quiet, "the bus is silent")
    with pytest.raises(DeviceFault, match="its driver's process is not healthy"):  # they are not left as the file says
        robot.close()


def test_the_example_describes_a_robot_that_can_be_attached(rig: Rig) -> None:
    from pathlib import Path

    rig.robot = load(Path(__file__).parents[3] / "examples" / "head.toml")
    rig.plug()
    robot = rig.attach()
    assert robot.group("head").joints() == ["rosie.neck.pan", "rosie.neck.tilt"]
