"""Cameras and sensors in robot files."""

from typing import Annotated

import pytest
from msgspec import Meta, Struct

from tests.support.simulated_robots import HEAD
from trade.errors import ConfigurationError
from trade_drivers import parse
from trade_robotfile import RobotFileError

EYE = '[camera.eye]\ndriver = "snapshot"\nurl = "http://eye/"\n'
OVEN = '[robot]\nname = "kitchen"\n\n[sensor."oven.temperature"]\ndriver = "acme"\nport = "/dev/ttyOVEN"\nprobes = 2\n'


class Options(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    port: str
    probes: Annotated[int, Meta(ge=1, le=4)] = 1
    limit: float = 0.0


def test_a_table_is_a_driver_and_whatever_else_that_wants_to_know() -> None:
    [camera] = parse(HEAD + EYE, "head.toml").cameras
    assert (camera.name, camera.driver, camera.options) == ("eye", "snapshot", {"url": "http://eye/"})


def test_a_robot_may_have_sensors_only() -> None:
    robot = parse(OVEN, "oven.toml")
    assert [sensor.name for sensor in robot.sensors] == ["oven.temperature"]
    assert robot.buses == robot.joints == []


def test_a_device_that_moves_nothing_is_no_member_of_a_lockable_group() -> None:
    assert parse(HEAD + EYE, "head.toml").members() == parse(HEAD, "head.toml").members()


def test_options_become_the_drivers_own_record() -> None:
    [sensor] = parse(OVEN, "oven.toml").sensors
    assert sensor.options_as(Options) == Options(port="/dev/ttyOVEN", probes=2)


WRONG_OPTIONS = [
    ("probes = 2", "probes = 9", r'oven\.toml: sensor\."oven\.temperature"\.probes: .*<= 4.*it is 9'),
    ("probes = 2", "prongs = 2", r"prongs: unknown key; the keys are port, probes, limit"),
    ('port = "/dev/ttyOVEN"', "", "missing required key 'port'; write port ="),
    ("probes = 2", "limit = nan", r"limit: must be a finite number"),
]


@pytest.mark.parametrize(("before", "after", "says"), WRONG_OPTIONS, ids=[case[1] or "port" for case in WRONG_OPTIONS])
def test_a_wrong_option_is_named_with_file_key_and_value(before: str, after: str, says: str) -> None:
    [sensor] = parse(OVEN.replace(before, after), "oven.toml").sensors
    with pytest.raises(RobotFileError, match=says):
        sensor.options_as(Options)


WRONG_FILES = [
    (HEAD + EYE.replace('driver = "snapshot"\n', ""), r"camera\.eye\.driver: must name its driver"),
    (HEAD + EYE.replace('"snapshot"', "3"), r"camera\.eye\.driver: must name its driver"),
    (HEAD + EYE.replace("camera.eye", 'camera."neck.pan"'), r'camera\."neck\.pan": a device or a bus has this name'),
    (HEAD + EYE.replace("camera.eye", "camera.neck"), r"camera\.neck: a device or a bus has this name"),
    (HEAD + EYE.replace("camera.eye", "camera.head"), r"group\.head: a device has this name already"),
    (HEAD + EYE + EYE.replace("camera", "sensor"), r"sensor\.eye: a device or a bus has this name"),
    (HEAD + EYE.replace("eye", "Eye"), "is no name"),
    (HEAD + EYE.replace("camera.eye", "camera.left.eye"), r'needs quotes: \[camera\."left\.eye"\]'),
    (OVEN + HEAD[HEAD.index("[joint.") : HEAD.index("[group.")], "there is no bus 'neck'; there is none"),
]


@pytest.mark.parametrize(("text", "says"), WRONG_FILES, ids=[case[1] for case in WRONG_FILES])
def test_a_wrong_file_is_refused_with_its_key(text: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        parse(text, "x.toml")
