"""What drivers refuse of a robot file, before anything is opened: with file, key and what would be right."""

from pathlib import Path

import pytest

from tests.support.simulated_robots import HAND, HEAD, TAIL
from tests.unit.drivers.legs import LEG
from trade.errors import ConfigurationError
from trade_drivers import Robot, attach, check, load, parse, refusals

GRIPPER = HAND[HAND.index("[gripper") :]
JOINT = TAIL[TAIL.index("[joint") : TAIL.index('[joint."tail.tip"]')]
PICTURES = '[robot]\nname = "rosie"\n[camera.eye]\ndriver = "snapshot"\nurl = "http://127.0.0.1/a.jpg"\n'


def read(text: str, *changes: tuple[str, str]) -> Robot:
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    return parse(text, "rosie.toml")


@pytest.mark.parametrize("text", [HEAD, TAIL, HAND, LEG, PICTURES])
def test_a_valid_file_is_refused_by_no_driver(text: str) -> None:
    assert not list(refusals(read(text)))


EXAMPLES = Path(__file__).parents[3] / "examples"
ROBOTS = [path for path in sorted(EXAMPLES.glob("*.toml")) if "\n[robot]" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", ROBOTS, ids=lambda path: path.stem)
def test_the_examples_are_refused_by_no_driver(path: Path) -> None:
    assert not list(refusals(load(path)))


@pytest.mark.parametrize(
    ("text", "change", "key", "problem"),
    [
        (TAIL, ("min_rad = -1.4", "min_rad = -70"), 'joint."tail.root".min_rad', "to 3.14"),
        (TAIL, ("min_rad = -1.4", "min_rad = -70"), 'joint."tail.root".min_rad', "degrees? radians are meant"),
        (TAIL, ("max_rad = 0.6", "max_rad = 4"), 'joint."tail.tip".max_rad', "4 is outside the range of an STS3215"),
        (HEAD, ("max_rad = 1.4", "max_rad = 50"), 'joint."neck.pan".max_rad', "degrees? radians are meant"),
        (TAIL, ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 60"), 'joint."tail.root".max_accel_rad_s2', "above"),
        (TAIL, ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 0.5"), 'joint."tail.root".max_accel_rad_s2', "takes"),
        (TAIL, ('"STS3215"', '"STS3216"'), 'joint."tail.root".model', "it supports STS3215"),
        (TAIL, ("[bus.tail]", "[bus.tail]\nbaud = 57600"), "bus.tail.baud", "57600 is no rate of these servos"),
        (TAIL, ("[bus.tail]", "[bus.tail]\nbaud = 1_000_001"), "bus.tail.baud", "they know 115200, 128000"),
        (HEAD, ("[bus.neck]", "[bus.neck]\nbaud = 38400"), "bus.neck.baud", "they know 9600"),
        (TAIL, ('"feetech"', '"feetek"'), "bus.tail.driver", "there is no driver 'feetek'; installed: "),
        (TAIL, ('port = "/dev/ttyNOTAIL"', 'host = "10.0.0.1"'), "bus.tail", "needs a serial bus"),
        (TAIL + GRIPPER, ('"hand"', '"tail"'), 'gripper."left.hand".bus', "which has no grippers, only joints"),
        (HAND + JOINT, ('"tail"', '"hand"'), 'joint."tail.root".bus', "which has no joints, only grippers"),
        (HAND, ("0.085", "85"), 'gripper."left.hand".max_width_m', "0 to 0.085"),
        (HAND, ("200.0", "5"), 'gripper."left.hand".max_force_n', "20 to 235"),
        (HAND, ("baud", "watchdog_s = 0.3\nbaud"), "bus.hand.watchdog_s", "leave this key out"),
        (HAND, ("baud = 115200\n", ""), "bus.hand.baud", "1000000 is no rate of a 2F-85; it knows 9600"),
        (LEG, ('"socketcan"', '"socketcan"\nrate_hz = 5'), "bus.legs.rate_hz", "too slow"),
        (PICTURES, ("url", "urls"), "camera.eye.urls", "unknown key; the keys are url, "),
        (PICTURES, ("http:", "ftp:"), "camera.eye.url", ""),
        (PICTURES, ('"snapshot"', '"feetech"'), "camera.eye.driver", "is not a subclass of trade_drivers.SenseDriver"),
    ],
)
def test_what_a_driver_cannot_do_is_refused_with_file_key_and_what_would_be_right(
    text: str, change: tuple[str, str], key: str, problem: str
) -> None:
    robot = read(text, change)
    [(_, refusal)] = refusals(robot)
    assert str(refusal).startswith(f"rosie.toml: {key}: ")
    assert problem in str(refusal)
    with pytest.raises(ConfigurationError) as raised:
        attach(robot, announced=False)
    assert str(raised.value) == str(refusal)


def test_each_faulty_bus_is_reported() -> None:
    text = TAIL.replace("feetech", "feetek") + HAND.replace("0.085", "85").split('"rosie"')[1]
    robot = read(text)
    assert [part for part, _ in refusals(robot)] == ["tail", "hand"]
    with pytest.raises(ConfigurationError, match="feetek"):
        check(robot)


@pytest.mark.parametrize("name", ["trade", "trade.rosie"])
def test_the_name_of_the_middleware_is_no_name_of_a_robot(name: str) -> None:
    with pytest.raises(ConfigurationError, match=r"rosie\.toml: robot\.name: .* is the middleware's own"):
        read(TAIL, ('"rosie"', f'"{name}"'))


def test_a_robot_may_have_a_name_that_begins_like_the_middleware() -> None:
    assert read(TAIL, ('"rosie"', '"trader"')).name == "trader"


@pytest.mark.parametrize(
    ("text", "change", "problem"),
    [
        (TAIL, ("[group.tail]", "[group.faults]"), 'group."faults": rosie.faults is the fault log; name'),
        (
            TAIL,
            ('"tail.root"', '"faults"'),
            'joint."faults": rosie.faults is the fault log; name the joints',
        ),
        (LEG, ('"leg.knee"', '"bus.legs"'), 'joint."bus.legs": rosie.bus.legs is the bus itself; name the joints'),
    ],
)
def test_what_drivers_name_themselves_is_no_name_of_a_device(text: str, change: tuple[str, str], problem: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        read(text, change)
    assert str(refused.value).startswith(f"rosie.toml: {problem}")
