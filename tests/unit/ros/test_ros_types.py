"""Types of the packages that a user has: they are read from the installation of ROS when they are used."""

from pathlib import Path
from typing import Any

import pytest

from tests.unit.ros.robots import Stand
from trade.errors import ConfigurationError
from trade_gateway.ros._connect import planned
from trade_gateway.ros_messages._types import Types, installed_definitions

pytestmark = pytest.mark.virtual_time

NAVIGATE = "geometry_msgs/PoseStamped pose\nstring behavior_tree\n---\nnav_lab/Verdict verdict\n---\nfloat32 left_m\n"
ENTRY = '[[from_ros.action]]\naction = "/go"\ntype = "nav_lab/action/Go"\ngroups = ["base"]\n'


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The share folder of an installation whose package nav_lab has an action, a message and a broken service."""
    package = tmp_path / "opt" / "share" / "nav_lab"
    for kind, name, text in (
        ("action", "Go.action", NAVIGATE),
        ("msg", "Verdict.msg", "uint16 code\nstring text\n"),
        ("srv", "Broken.srv", "this is no definition"),
    ):
        (package / kind).mkdir(parents=True)
        (package / kind / name).write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'opt'}")
    return package.parent


def _types() -> Types:
    return Types(2, installed=installed_definitions(2))


def test_a_type_is_read_with_those_in_it_when_it_is_used(share: Path) -> None:
    types = _types()
    goal, result, _ = types.parts("nav_lab/action/Go")
    assert [field.name for field in types.fields(goal)] == ["pose", "behavior_tree"]
    message: dict[str, Any] = {"verdict": {"code": 7, "text": "stuck"}}
    assert types.from_bytes(result, types.to_bytes(result, message)) == message
    with pytest.raises(ConfigurationError, match="needs 2 parts"):
        types.parts("nav_lab/srv/Broken")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("nav_lab/action/Stay", "nav_lab/action/Stay is not known: package nav_lab is installed, but without it"),
        ("my_lab/msg/Level", "my_lab/msg/Level is not known: package my_lab is not installed"),
        ("my_lab/msg/Verdict", "my_lab/msg/Verdict is not known: package my_lab is not installed"),
        ("nav_lab/../../Verdict", "is not known"),
        ("Verdict", "is not known"),
    ],
)
def test_a_missing_type_is_named_with_its_package(share: Path, name: str, says: str) -> None:
    types = _types()
    with pytest.raises(ConfigurationError, match=says):
        types.fields(name) if "/msg/" in name else types.parts(name)


def test_a_type_inside_a_type_is_named_if_it_is_missing(share: Path) -> None:
    (share / "nav_lab" / "msg" / "Verdict.msg").unlink()
    types = _types()
    with pytest.raises(ConfigurationError, match="nav_lab/msg/Verdict is not known"):
        types.fields(types.parts("nav_lab/action/Go")[1])


def test_the_check_of_a_file_finds_installed_types(stand: Stand, share: Path) -> None:
    lines = planned(stand.read(ENTRY), stand.folder / "ros.toml")
    assert lines == ["from ROS: action /go (nav_lab/action/Go, actuate) in base"]


def test_ros_1_has_its_definitions_in_the_packages_of_its_path(share: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(share))
    types = Types(1, installed=installed_definitions(1))
    assert [field.name for field in types.fields("nav_lab/msg/Verdict")] == ["code", "text"]
