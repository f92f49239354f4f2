"""Cameras: the contract, on a simulated one, and what it sees of the robot and says when something is wrong."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.support.fake_container import fake_container
from tests.support.simulated_robots import HAND, HEAD
from trade.errors import ConfigurationError, DeviceFault, DeviceSilent, InvalidArgument
from trade_drivers import AttachedRobot, Camera, Image, attach, load, parse
from trade_drivers.testing import CameraContract
from trade_hil_sim import (
    ByteLog,
    Freeze,
    Garbage,
    Heal,
    Late,
    Mute,
    Put,
    Replug,
    SimProcess,
    SimulationError,
    Truncate,
    Unplug,
)
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.robot._robot import buses_of
from trade_hil_sim.scene import LIMB, OBJECT, Field, fields

pytestmark = pytest.mark.virtual_time

EYE = """
[camera.eye]
driver = "snapshot"
url = "http://192.168.0.20/snapshot.jpg"
width_px = 160
height_px = 120
"""
SEEN = HEAD + HAND[HAND.index("[bus.") :] + EYE


class Stage:
    """A robot with a camera on it, attached to its simulation."""

    def __init__(self, text: str, folder: Path, undo: ExitStack) -> None:
        self.file = parse(text, "seen.toml")
        self.sims: dict[str, Any] = {}
        self.log = ByteLog()
        for sim in buses_of(self.file, folder, log=self.log, paced=False):
            undo.callback(sim.close)
            sim.open()
            self.sims[sim.name] = sim
        self._undo = undo

    def attach(self, **changed: str) -> AttachedRobot:
        ports = {name: str(sim.port) for name, sim in self.sims.items()}
        return self._undo.enter_context(attach(self.file, announced=False, ports={**ports, **changed}))

    def field(self, device: str) -> Field:
        states = [sim.state() for sim in self.sims.values()]
        return fields(states, 160, 120)[device]


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with ExitStack() as undo:
        yield Stage(SEEN, tmp_path, undo)


@pytest.fixture
def robot(stage: Stage) -> AttachedRobot:
    return stage.attach()


@pytest.fixture
def camera(robot: AttachedRobot) -> Camera:
    return robot.camera("eye")


class TestSnapshotCamera(CameraContract):
    @pytest.fixture
    def camera(self, robot: AttachedRobot) -> Camera:
        return robot.camera("eye")


class Pixels:
    """A picture, taken apart with nothing of the writer's."""

    def __init__(self, image: Image) -> None:
        at, packed = 8, b""
        while at < len(image.data):
            length, kind = struct.unpack_from(">I4s", image.data, at)
            body = image.data[at + 8 : at + 8 + length]
            assert zlib.crc32(kind + body) == int.from_bytes(image.data[at + 8 + length : at + 12 + length], "big")
            packed += body if kind == b"IDAT" else b""
            at += 12 + length
        rows = zlib.decompress(packed)
        self._wide, step = image.width_px, 1 + 3 * image.width_px
        assert len(rows) == step * image.height_px
        assert not any(rows[::step]), "every row is unfiltered"
        self._rows = [rows[at + 1 : at + step] for at in range(0, len(rows), step)]

    def where(self, colour: tuple[int, int, int], field: Field) -> set[tuple[int, int]]:
        """The pixels of a field that have a colour, from its upper left."""
        return {
            (x, y)
            for y in range(field.height)
            for x in range(field.width)
            if tuple(self._rows[field.top + y][3 * (field.left + x) : 3 * (field.left + x) + 3]) == colour
        }


def test_a_joint_that_has_moved_is_seen_elsewhere_and_the_others_are_not(
    stage: Stage, robot: AttachedRobot, camera: Camera
) -> None:
    pan, tilt = stage.field("neck.pan"), stage.field("neck.tilt")
    before = Pixels(camera.image())
    robot.motor("neck.pan").move_to(1.2)
    after = Pixels(camera.image())
    assert before.where(LIMB, pan) != after.where(LIMB, pan)
    assert before.where(LIMB, tilt) == after.where(LIMB, tilt) != set()
    assert _top(after.where(LIMB, pan)) < _top(before.where(LIMB, pan)), "a positive angle turns it upwards"


def test_the_fingers_of_a_gripper_are_seen_to_close_around_the_object(
    stage: Stage, robot: AttachedRobot, camera: Camera
) -> None:
    hand = stage.field("left.hand")
    gripper = robot.gripper("left.hand")
    gripper.activate()
    gripper.open()
    apart = Pixels(camera.image())
    assert not apart.where(OBJECT, hand)
    stage.sims["hand"].do(Put(width_m=0.04))
    placed = Pixels(camera.image())
    assert _gap(placed.where(LIMB, hand)) == _gap(apart.where(LIMB, hand))
    assert placed.where(OBJECT, hand)
    assert gripper.close().holding == "outside"
    held = Pixels(camera.image())
    assert 0 < _gap(held.where(LIMB, hand)) < _gap(placed.where(LIMB, hand))
    assert held.where(OBJECT, hand)


def _top(pixels: set[tuple[int, int]]) -> int:
    return min(y for _, y in pixels)


def _gap(pixels: set[tuple[int, int]]) -> int:
    """The widest stretch without a finger between two of them."""
    columns = sorted({x for x, _ in pixels})
    return max(right - left for left, right in pairwise(columns))


@pytest.mark.realtime
def test_the_example_is_seen_to_move_in_a_simulator_of_its_own() -> None:
    file = Path(__file__).parents[3] / "examples" / "eye.toml"
    with (
        SimProcess(file, paced=False) as sim,
        attach(load(file), announced=False, ports=sim.ports) as robot,
    ):
        before = robot.camera("eye").image()
        robot.motor("neck.pan").move_to(0.5)
        after = robot.camera("eye").image()
        place = fields(sim.control.state(), before.width_px, before.height_px)["neck.pan"]
        assert Pixels(before).where(LIMB, place) != Pixels(after).where(LIMB, place)


def test_a_camera_that_does_not_answer_is_silent_and_is_back_by_itself(stage: Stage, camera: Camera) -> None:
    stage.sims["eye"].do(Unplug())
    with pytest.raises(DeviceSilent, match=r"rosie\.eye did not answer on http://127"):
        camera.image()
    stage.sims["eye"].do(Replug())
    assert camera.image().data


def test_a_picture_that_takes_too_long_or_trickles_in_is_given_up_in_time(tmp_path: Path) -> None:
    with ExitStack() as undo:
        stage = Stage(SEEN.replace("height_px = 120", "height_px = 120\ntimeout_s = 0.2"), tmp_path, undo)
        camera = stage.attach().camera("eye")
        for fault in (Late(s=5.0), Mute(), faults.Dribble(s=0.05)):  # each byte in time, all of them in a minute
            stage.sims["eye"].do(fault)
            with pytest.raises(DeviceSilent):
                camera.image()
            stage.sims["eye"].do(Heal())


@pytest.mark.parametrize("fault", [Truncate(missing=20), Garbage(hex="00" * 8)], ids=["truncated", "garbage"])
def test_an_incomplete_picture_is_never_returned(stage: Stage, camera: Camera, fault: faults.Command) -> None:
    stage.sims["eye"].do(fault)
    with pytest.raises((DeviceFault, DeviceSilent)):
        camera.image()
    stage.sims["eye"].do(Heal())
    assert camera.image().data


def test_a_frozen_camera_shows_an_old_picture(stage: Stage, robot: AttachedRobot, camera: Camera) -> None:
    stage.sims["eye"].do(Freeze())
    before = camera.image().data
    robot.motor("neck.pan").move_to(1.2)
    assert camera.image().data == before
    stage.sims["eye"].do(Freeze(on=False))
    assert camera.image().data != before


def test_a_command_that_a_camera_does_not_have_is_refused(stage: Stage) -> None:
    with pytest.raises(SimulationError, match="camera eye has no such thing as Jam"):
        stage.sims["eye"].do(faults.Jam())


def test_a_camera_of_another_size_than_the_file_says_is_refused(stage: Stage) -> None:
    robot = parse(SEEN.replace("width_px = 160", "width_px = 640"), "seen.toml")
    ports = {name: str(sim.port) for name, sim in stage.sims.items()}
    with pytest.raises(ConfigurationError, match=r"seen\.toml: camera\.eye\.width_px: its pictures have 160, not 640"):
        attach(robot, announced=False, ports=ports)


@pytest.mark.parametrize(
    ("port", "says"),
    [
        ("http://127.0.0.1:9/scene.png", r"camera\.eye\.url: .*did not answer"),
        ("https://127.0.0.1/x", "no https"),
        ("http://127.0.0.1/a b", "%20"),
        ("/dev/video0", "is not like http://"),
    ],
)
def test_a_camera_that_is_not_there_is_refused_with_its_key(stage: Stage, port: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        stage.attach(eye=port)


def test_a_page_that_is_no_picture_is_refused_with_what_the_server_said(stage: Stage) -> None:
    other = stage.sims["eye"].port.replace("scene.png", "index.html")
    with pytest.raises(ConfigurationError, match="HTTP 404 Not Found"):
        stage.attach(eye=other)


def test_a_driver_of_buses_is_none_of_cameras(stage: Stage) -> None:
    text = SEEN.replace('driver = "snapshot"', 'driver = "dynamixel"')
    with pytest.raises(ConfigurationError, match=r"camera\.eye\.driver.*is not a subclass of .*\.SenseDriver"):
        attach(parse(text, "seen.toml"), ports={name: str(sim.port) for name, sim in stage.sims.items()})


def test_a_driver_of_cameras_is_none_of_sensors(stage: Stage) -> None:
    text = SEEN.replace("[camera.eye]", "[sensor.eye]")
    with pytest.raises(ConfigurationError, match=r"sensor\.eye\.driver: driver 'snapshot' has no sensors"):
        attach(parse(text, "seen.toml"), ports={name: str(sim.port) for name, sim in stage.sims.items()})


def test_unless_every_camera_is_present_nothing_is_announced_and_no_motor_gets_a_byte(stage: Stage) -> None:
    announced: list[object] = []
    ports = {name: str(sim.port) for name, sim in stage.sims.items()} | {"eye": "http://127.0.0.1:9/"}
    with pytest.raises(ConfigurationError):
        attach(stage.file, fake_container(register=lambda *given: announced.append(given)), ports=ports)
    assert not announced
    assert not [entry for entry in stage.log.entries if entry.bus == "neck" and entry.kind == "received"]


def test_attaching_and_looking_only_ask_for_the_picture(stage: Stage) -> None:
    robot = stage.attach()
    robot.camera("eye").image()
    robot.close()
    asked = [entry.detail for entry in stage.log.entries if (entry.bus, entry.name) == ("eye", "received")]
    assert asked == 2 * ["GET /scene.png HTTP/1.0"]


def test_the_camera_has_its_group_and_no_other_kind_of_provider_does(robot: AttachedRobot) -> None:
    assert isinstance(robot.providers["rosie.eye"], Camera)
    with pytest.raises(KeyError):
        robot.motor("eye")
    with pytest.raises(KeyError):
        robot.camera("neck.pan")


def test_its_services_take_no_arguments(camera: Camera) -> None:
    from trade import where
    from trade.testing import memory_system

    with memory_system() as system:
        system.container("driver").register(camera, "rosie.eye")
        system.settle()
        image = system.container("viewer").find(where(name="image", group="rosie.eye"))
        assert image().data == camera.image().data
        with pytest.raises(InvalidArgument):
            image(640)
        system.container("driver").deregister(camera)
