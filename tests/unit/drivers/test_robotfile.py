"""Robot files: what is read, and what each mistake is answered with."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from tests.support.simulated_robots import HAND, HEAD
from trade.errors import ConfigurationError
from trade_drivers import CanBus, Robot, SerialBus, load, parse, without
from trade_robotfile import Drill


def test_a_robot_file_becomes_records() -> None:
    robot = parse(HEAD, "head.toml")
    assert (robot.name, robot.where) == ("rosie", "head.toml")
    assert [joint.name for joint in robot.joints_on("neck")] == ["neck.pan", "neck.tilt"]
    assert robot.joints[1].reversed
    assert (robot.buses[0].rate_hz, robot.buses[0].leave, robot.buses[0].watchdog_s) == (100.0, "hold", 0.3)
    assert robot.groups[0].joints == ["neck.pan", "neck.tilt"]


def test_a_robot_knows_who_belongs_to_its_groups_and_to_what_its_joints_are_named_after() -> None:
    robot = parse(f'{HEAD}[group.first]\njoints = ["neck.pan"]', "head.toml")
    both = ["rosie.neck.pan", "rosie.neck.tilt"]
    assert robot.members() == {
        "rosie": both,
        "rosie.neck": both,
        "rosie.head": both,
        "rosie.first": ["rosie.neck.pan"],
    }


def test_coupled_joints_name_each_other() -> None:
    robot = parse(f'{HEAD}[[coupled]]\njoints = ["neck.pan", "neck.tilt"]', "head.toml")
    assert robot.coupled_to("neck.pan") == ["rosie.neck.tilt"]
    assert robot.coupled_to("neck.tilt") == ["rosie.neck.pan"]
    assert parse(HEAD, "head.toml").coupled_to("neck.pan") == []


def test_buses_with_processes_of_their_own_leave_the_rest_to_another_one() -> None:
    assert two_buses().own_processes() == []
    assert two_buses(left="own").own_processes() == ["left"]
    assert two_buses(right="own").own_processes() == ["right"]
    assert two_buses(left="own", right="own").own_processes() == ["right"]
    assert without(two_buses(left="own", right="own"), ["right"])[0].own_processes() == []


def test_a_bus_without_devices_needs_no_process() -> None:
    unused = HEAD.replace("[joint", '[bus.unused]\ndriver = "dynamixel"\nport = "x"\nprocess = "own"\n\n[joint', 1)
    assert parse(unused, "head.toml").own_processes() == []


@pytest.mark.parametrize("table", ["[group.both]", "[[coupled]]"])
def test_joints_of_two_processes_are_neither_grouped_nor_coupled(table: str) -> None:
    joints = f'{table}\njoints = ["left", "right"]'
    assert two_buses(joints).joints
    with pytest.raises(ConfigurationError, match="left is on bus 'left' with a process of its own, and right is not"):
        two_buses(joints, left="own")
    with pytest.raises(ConfigurationError, match="right is on bus 'right' with a process of its own, and left is not"):
        two_buses(joints, right="own")


def two_buses(more: str = "", **process: str) -> Robot:
    buses = "".join(
        f"""
[bus.{name}]
driver = "dynamixel"
port = "{name}"
process = "{process.get(name, "shared")}"

[joint.{name}]
bus = "{name}"
id = 1
model = "XL430-W250"
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0
"""
        for name in ("left", "right")
    )
    return parse(f'[robot]\nname = "rosie"\n{buses}\n{more}', "two.toml")


LEGS = """
[robot]
name = "rosie"

[bus.legs]
driver = "cia402"
interface = "socketcan"
channel = "can0"

[joint."legs.hip"]
bus = "legs"
id = 1
model = "drive"
counts_per_rev = 4096
gear = 50
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0
"""


def test_the_limits_of_a_drill_are_seconds_and_may_be_left_out() -> None:
    assert parse(HEAD, "head.toml").drill == Drill()
    assert parse(f"{HEAD}\n[drill]\npartition = 3\n", "head.toml").drill == Drill(partition=3.0)


def test_a_bus_with_the_words_of_python_can_is_a_can_bus() -> None:
    robot = parse(LEGS, "legs.toml")
    [bus], [joint] = robot.buses, robot.joints
    assert isinstance(bus, CanBus)
    assert (bus.interface, bus.channel, bus.bitrate, bus.port) == ("socketcan", "can0", 1_000_000, "socketcan:can0")
    assert (joint.counts_per_rev, joint.gear) == (4096.0, 50.0)


def test_a_bus_with_a_port_is_a_serial_bus_and_its_joints_need_no_counts() -> None:
    robot = parse(HEAD, "head.toml")
    assert isinstance(robot.buses[0], SerialBus)
    assert (robot.joints[0].counts_per_rev, robot.joints[0].gear) == (None, 1.0)


CAN_MISTAKES = [
    ('channel = "can0"', 'port = "/dev/tty"', "bus.legs: 'port' is a key of a serial bus and 'interface' one of a CAN"),
    ('channel = "can0"\n', "", "bus.legs: missing required key 'channel'; write channel = \"can0\""),
    ('interface = "socketcan"\n', "", "bus.legs: missing required key 'interface'; write interface = \"socketcan\""),
    ('"socketcan"', '"udp_multicast"', "bus.legs.interface: 'udp_multicast' loses frames and echoes a sender's own"),
    ('"socketcan"', '"socketcan:can0"', "bus.legs.interface: Expected `str` matching"),
    ('"can0"', '"can0"\nbitrate = 2000000', "bus.legs.bitrate: Expected `int` <= 1000000, but it is 2000000"),
    ("gear = 50", "gear = 0", 'joint."legs.hip".gear: Expected `float` > 0'),
    ("counts_per_rev = 4096", "counts_per_rev = -1", 'joint."legs.hip".counts_per_rev: Expected `float` > 0'),
]


@pytest.mark.parametrize(("before", "after", "complaint"), CAN_MISTAKES, ids=[m[2][:40] for m in CAN_MISTAKES])
def test_a_mistake_on_a_can_bus_is_answered_so_too(before: str, after: str, complaint: str) -> None:
    assert before in LEGS
    with pytest.raises(ConfigurationError) as error:
        parse(LEGS.replace(before, after, 1), "legs.toml")
    assert complaint in str(error.value)


MISTAKES = [
    (
        "[robot]\nname",
        "name",
        (
            "head.toml: [name]: unknown table; "
            "a robot file has [robot], [bus], [joint], [gripper], [arm], [camera], [sensor], [group], [drill], "
            "[[coupled]]"
        ),
    ),
    ('name = "rosie"', "", 'head.toml: [robot]: missing; write [robot] and name = "rosie"'),
    ('name = "rosie"', 'name = "Rosie"', "robot.name: 'Rosie' is no name"),
    ('name = "rosie"', 'name = "rosie"\nage = 3', "robot.age: unknown key; [robot] has only name"),
    ("[robot]", "[robots]", "[robots]: unknown table"),
    ("[bus.neck]", "[bus.", "not valid TOML"),
    (
        '[joint."neck.tilt"]',
        '[joint."neck.pan"]',
        'head.toml: not valid TOML: there are two of the name [joint."neck.pan"] (at line',
    ),
    ('driver = "dynamixel"\n', "", "bus.neck: missing required key 'driver'; write driver = \"dynamixel\""),
    ('port = "/dev/ttyNOWHERE"\n', "", "bus.neck: missing required key 'port'; write port = \"/dev/serial/by-id/"),
    ('port = "/dev/ttyNOWHERE"', 'port = ""', "bus.neck.port: Expected `str` of length >= 1, but it is ''"),
    ('driver = "dynamixel"', 'driver = "dynamixel"\nbuad = 1', "bus.neck.buad: unknown key; the keys are driver"),
    (
        'driver = "dynamixel"',
        'driver = "dynamixel"\nbaud = 300',
        "bus.neck.baud: Expected `int` >= 9600, but it is 300",
    ),
    ('driver = "dynamixel"', 'driver = "dynamixel"\nbaud = "1M"', "bus.neck.baud: Expected `int`, got `str`"),
    ('driver = "dynamixel"', 'driver = "dynamixel"\nrate_hz = 0', "bus.neck.rate_hz: Expected `float` > 0"),
    ('driver = "dynamixel"', 'driver = "dynamixel"\nrate_hz = nan', "bus.neck.rate_hz"),
    ('driver = "dynamixel"', 'driver = "dynamixel"\nwatchdog_s = 9', "bus.neck.watchdog_s: Expected `float` <= 2"),
    (
        'driver = "dynamixel"',
        'driver = "dynamixel"\nleave = "drop"',
        'leave: must be "hold" or "relax", but it is \'drop\'',
    ),
    ('[joint."neck.pan"]', "[joint.neck.pan]", 'a dotted name needs quotes: [joint."neck.pan"]'),
    ('[joint."neck.pan"]', '[joint."Neck"]', "'Neck' is no name"),
    ('[joint."neck.pan"]\nbus = "neck"', '[joint."neck.pan"]\nbus = "foot"', "there is no bus 'foot'; there is neck"),
    ("id = 1\n", "id = 2\n", "id: 2 is taken on bus 'neck' by joint 'neck.pan'"),
    ("id = 1\n", "id = 253\n", "id: Expected `int` <= 252, but it is 253"),
    ("id = 1\n", "id = 1.5\n", "id: Expected `int`"),
    ("id = 1\n", "", "missing required key 'id'"),
    ("max_rad = 1.4", "max_rad = inf", "max_rad: must be a finite number, but it is inf"),
    ("min_rad = -1.4", "min_rad = nan", "min_rad: must be a finite number, but it is nan"),
    ("max_rad = 1.4", "max_rad = -1.4", "max_rad: must be greater than min_rad, but -1.4 <= -1.4"),
    ("max_speed_rad_s = 2.5", "max_speed_rad_s = inf", "max_speed_rad_s: must be a finite number"),
    ("max_speed_rad_s = 2.5", "max_speed_rad_s = 0", "max_speed_rad_s: Expected `float` > 0"),
    ("max_speed_rad_s = 2.5", "max_speed_rad_s = -1", "max_speed_rad_s: Expected `float` > 0"),
    ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = true", "max_accel_rad_s2: Expected `float`, got `bool`"),
    ("reversed = true", "offset_rad = inf", "offset_rad: must be a finite number"),
    ("[group.head]", '[group."neck.pan"]', "a device has this name already"),
    (
        '"neck.pan", "neck.tilt"]',
        '"neck.pan", "neck.nod"]',
        "group.head.joints: there is no joint 'neck.nod'; there is neck.pan, neck.tilt",
    ),
    ('"neck.pan", "neck.tilt"]', '"neck.pan", "neck.pan"]', "names a joint twice"),
    (
        "[group.head]",
        '[[coupled]]\njoints = ["neck.pan", "neck.nod"]\n[group.head]',
        "coupled 1.joints: there is no joint 'neck.nod'; there is neck.pan, neck.tilt",
    ),
    (
        "[group.head]",
        '[[coupled]]\njoints = ["neck.pan"]\n[group.head]',
        "coupled 1.joints: Expected `array` of length",
    ),
    ("[group.head]", '[[coupled]]\njoints = ["neck.pan", "neck.pan"]\n[group.head]', "coupled 1.joints: names a joint"),
    ("[group.head]", "[[coupled]]\n[group.head]", "coupled 1: missing required key 'joints'"),
    ("[group.head]", "[coupled]\n[group.head]", "coupled: must be a list of tables, each with a heading of its own"),
    ("[robot]", "coupled = [3]\n[robot]", "coupled 1"),
    ("[robot]", "[drill]\npartitoin = 3\n[robot]", "drill.partitoin: unknown key; the keys are caller_killed, "),
    ("[robot]", "[drill]\npartition = 0\n[robot]", "drill.partition: Expected `float` > 0"),
    ("[robot]", "[drill]\npartition = inf\n[robot]", "drill.partition: must be a finite number"),
    ("[robot]", "drill = 3\n[robot]", "drill: must be a table: [drill]"),
    ('["neck.pan", "neck.tilt"]', "[]", "group.head.joints: Expected `array` of length >= 1"),
]


@pytest.mark.parametrize(("before", "after", "complaint"), MISTAKES, ids=[m[2][:40] for m in MISTAKES])
def test_a_mistake_is_answered_with_the_key_and_what_would_be_right(before: str, after: str, complaint: str) -> None:
    assert before in HEAD
    with pytest.raises(ConfigurationError) as error:
        parse(HEAD.replace(before, after, 1), "head.toml")
    assert str(error.value).startswith("head.toml: ")
    assert complaint in str(error.value)


def test_two_buses_on_one_port_are_refused() -> None:
    other = '[bus.arm]\ndriver = "dynamixel"\nport = "/dev/ttyNOWHERE"\n'
    with pytest.raises(ConfigurationError, match="is the port of bus 'neck' already"):
        parse(HEAD + other, "head.toml")


def test_a_file_with_nothing_in_it_says_what_is_missing() -> None:
    for text, missing in (("", r"\[robot\]"), ('[robot]\nname = "r"', r"\[bus.NAME\]")):
        with pytest.raises(ConfigurationError, match=missing):
            parse(text, "empty.toml")


def test_load_reads_a_file(tmp_path: Path) -> None:
    file = tmp_path / "head.toml"
    file.write_text(HEAD)
    assert isinstance(load(file), Robot)
    assert load(str(file)).where == str(file)


def test_load_says_what_is_wrong_with_the_file_itself(tmp_path: Path) -> None:
    latin = tmp_path / "latin.toml"
    latin.write_bytes("# K\u00f6rper".encode("latin-1"))
    for path, complaint in (
        (tmp_path / "missing.toml", "there is no such file"),
        (tmp_path, "is a directory"),
        (latin, "is not UTF-8 text"),
        (latin / "below", "cannot be read"),
    ):
        with pytest.raises(ConfigurationError, match=complaint) as error:
            load(path)
        assert str(path) in str(error.value)


def test_grippers_are_records_and_members_like_joints() -> None:
    robot = parse(HAND, "hand.toml")
    assert [gripper.name for gripper in robot.grippers_on("hand")] == ["left.hand"]
    assert (robot.joints, robot.grippers[0].min_width_m) == ([], 0.0)
    assert robot.members() == {"rosie": ["rosie.left.hand"], "rosie.left": ["rosie.left.hand"]}


def test_rosie_is_her_parts() -> None:
    examples = Path(__file__).parents[3] / "examples"
    whole = load(examples / "rosie.toml")
    parts = [load(examples / name) for name in ("head.toml", "hand.toml", "servo_arm.toml", "legs.toml", "tail.toml")]
    [left_arm], [arm] = whole.arms, load(examples / "arm.toml").arms
    assert whole.joints == [joint for part in parts for joint in part.joints]
    assert whole.grippers == [gripper for part in parts for gripper in part.grippers]
    assert whole.groups == [group for part in parts for group in part.groups]
    named = [bus.name for part in parts for bus in part.buses]
    assert [bus.name for bus in whole.buses if bus.name != left_arm.bus] == named
    assert replace(left_arm, name=arm.name, bus=arm.bus, poses=arm.poses) == arm


GRIPPER_MISTAKES = [
    ("max_force_n = 200.0\n", "", "gripper.\"left.hand\": missing required key 'max_force_n'"),
    ("max_width_m = 0.085", "max_width_m = nan", 'gripper."left.hand".max_width_m'),
    ("max_width_m = 0.085", "max_width_m = 0.085\nmin_width_m = 0.1", "must be greater than min_width_m"),
    ("id = 9", "id = 0", "Expected `int` >= 1, but it is 0"),
    ('bus = "hand"', 'bus = "foot"', "gripper.\"left.hand\".bus: there is no bus 'foot'; there is hand"),
    ('[gripper."left.hand"]', "[gripper.left.hand]", 'a dotted name needs quotes: [gripper."left.hand"]'),
]


@pytest.mark.parametrize(("before", "after", "complaint"), GRIPPER_MISTAKES, ids=[m[2][:40] for m in GRIPPER_MISTAKES])
def test_a_mistake_about_a_gripper_is_answered_with_the_key(before: str, after: str, complaint: str) -> None:
    assert before in HAND
    with pytest.raises(ConfigurationError) as error:
        parse(HAND.replace(before, after, 1), "hand.toml")
    assert complaint in str(error.value)


def test_a_gripper_and_a_joint_share_neither_id_nor_name_and_a_robot_has_one_of_them() -> None:
    second = HAND[HAND.index("[gripper") :]
    for text, complaint in (
        (HAND + second.replace("left", "right"), "9 is taken on bus 'hand' by gripper 'left.hand'"),
        (HEAD + second.replace("left.hand", "neck.pan").replace('"hand"', '"neck"'), "a joint has this name already"),
        (HAND.replace(second, ""), "a robot needs at least one joint, gripper, arm, camera or sensor"),
    ):
        with pytest.raises(ConfigurationError) as error:
            parse(text, "hand.toml")
        assert complaint in str(error.value)
