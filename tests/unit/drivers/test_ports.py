"""One port under two names in a robot file: both keys are in the refusal, and nothing is opened."""

from pathlib import Path

import pytest
import serial  # noqa: F401 - virtual time replaces it only if it was imported before

from tests.support.simulated_robots import HEAD, TAIL
from tests.unit.drivers.tail_rig import TailRig, rig
from trade.errors import ConfigurationError
from trade_drivers import Robot, check, load_driver, parse
from trade_drivers.plugins._driver import Driver
from trade_hil_sim import received

__all__ = ["rig"]

BOTH = HEAD + TAIL.split('"rosie"')[1]
LEGS = """
[robot]
name = "rosie"
[bus.left]
driver = "cia402"
interface = "{}"
channel = "{}"
[bus.right]
driver = "cia402"
interface = "{}"
channel = "{}"
[joint.hip]
bus = "left"
id = 1
model = "ACME"
counts_per_rev = 4096
min_rad = -0.8
max_rad = 0.8
max_speed_rad_s = 1.5
max_accel_rad_s2 = 10.0
"""
ARMS = """
[robot]
name = "rosie"
[bus.left]
driver = "ur"
host = "{}"
[bus.right]
driver = "ur"
host = "{}"
[camera.eye]
driver = "snapshot"
url = "http://127.0.0.1/eye.jpg"
"""


def two(neck: object, tail: object) -> Robot:
    return parse(BOTH.replace("/dev/ttyNOWHERE", str(neck)).replace("/dev/ttyNOTAIL", str(tail)), "rosie.toml")


def refusal(robot: Robot) -> str:
    with pytest.raises(ConfigurationError) as refused:
        check(robot)
    return str(refused.value)


@pytest.mark.virtual_time
def test_an_adapter_under_two_names_is_refused_before_anything_is_opened(rig: TailRig, tmp_path: Path) -> None:
    rig.plug()
    link = tmp_path / "by-id"
    link.symlink_to(rig.sim.port)
    tail, tip = TAIL.split('[joint."tail.tip"]')
    other = tail.split('"rosie"')[1].split("[joint")[0].replace("bus.tail", "bus.tip")
    rig.robot = parse(
        f'{tail}{other}[joint."tail.tip"]{tip}'.replace('bus = "tail"\nid = 2', 'bus = "tip"\nid = 2')
        .replace("/dev/ttyNOTAIL", str(rig.sim.port), 1)
        .replace("/dev/ttyNOTAIL", str(link)),
        "tail.toml",
    )
    with pytest.raises(ConfigurationError, match=r"bus.tip.port: .*bus.tail.port already"):
        rig.attach(ports={})
    assert not received(rig.log)
    with load_driver("feetech", "", Driver).commissioner().at(str(rig.sim.port), 1_000_000) as bench:
        assert bench.look(1) is not None  # the control: the simulated port works, and was not taken


def test_a_link_to_the_port_of_another_bus_is_refused_with_both_keys(tmp_path: Path) -> None:
    link = tmp_path / "usb-1a86_USB_Single_Serial-if00"
    link.symlink_to("/dev/null")
    text = refusal(two("/dev/null", link))
    assert text.startswith("rosie.toml: bus.tail.port: ")
    assert str(link) in text
    assert "of bus.neck.port already, there as /dev/null" in text


def test_links_to_an_adapter_that_is_not_plugged_in_are_one_port_too(tmp_path: Path) -> None:
    for name in ("one", "other"):
        (tmp_path / name).symlink_to(tmp_path / "ttyUSB0")
    assert "bus.tail.port" in refusal(two(tmp_path / "one", tmp_path / "other"))


def test_two_adapters_are_two_ports(tmp_path: Path) -> None:
    for name, device in (("one", "/dev/null"), ("other", "/dev/zero")):
        (tmp_path / name).symlink_to(device)
    check(two(tmp_path / "one", tmp_path / "other"))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (("socketcand", "localhost/can0"), ("socketcand", "127.0.0.1:29536/can0")),
        (("slcan", "/dev/null@115200"), ("slcan", "/dev/stdnull")),
    ],
)
def test_a_can_bus_under_two_names_is_refused_with_both_keys(
    left: tuple[str, str], right: tuple[str, str], tmp_path: Path
) -> None:
    (tmp_path / "stdnull").symlink_to("/dev/null")
    right = (right[0], right[1].replace("/dev/stdnull", str(tmp_path / "stdnull")))
    text = refusal(parse(LEGS.format(*left, *right), "legs.toml"))
    assert text.startswith("legs.toml: bus.right.channel: ")
    assert "bus.left.channel" in text


def test_two_channels_of_a_server_are_two_buses() -> None:
    check(parse(LEGS.format("socketcand", "localhost/can0", "socketcand", "127.0.0.1:29536/can1"), "legs.toml"))


def test_a_can_adapter_that_is_also_a_serial_bus_is_refused_with_both_keys() -> None:
    slcan = LEGS.partition('"rosie"')[2].partition("[bus.right]")[0].format("slcan", "/dev/null@115200")
    joint = LEGS[LEGS.index("[joint.hip]") :]
    text = BOTH.replace("/dev/ttyNOWHERE", "/dev/null") + slcan + joint
    assert "bus.left.channel" in (said := refusal(parse(text, "rosie.toml")))
    assert "bus.neck.port" in said


def test_an_arm_under_two_names_is_refused_with_both_keys() -> None:
    said = refusal(parse(ARMS.format("localhost", "127.0.0.1"), "arms.toml"))
    assert said.startswith("arms.toml: bus.right.host: ")
    assert "bus.left.host" in said
