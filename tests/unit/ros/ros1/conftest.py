"""A ROS 1 system, and ours as a node of it."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.ros1_system import Stand, need_ros1
from tests.support.waiting import wait_until
from trade_gateway.ros.ros1 import Ros1

TEST_ACTION = "int32 goal\n---\nint32 result\n---\nint32 feedback\n"


@pytest.fixture(scope="session")
def _ros1() -> None:
    need_ros1()


@pytest.fixture
def stand(_ros1: None, tmp_path: Path) -> Iterator[Stand]:
    made = Stand(tmp_path / "home")
    made.start_master()
    yield made
    made.close()


@pytest.fixture
def types(tmp_path: Path) -> Path:
    """A folder with the action that actionlib's own tests use."""
    path = tmp_path / "types" / "actionlib" / "action" / "Test.action"
    path.parent.mkdir(parents=True)
    path.write_text(TEST_ACTION)
    return tmp_path / "types"


StartRos1 = Callable[..., Ros1]


@pytest.fixture
def start_ros1(stand: Stand, types: Path) -> Iterator[StartRos1]:
    started: list[Ros1] = []

    def start(**arguments: object) -> Ros1:
        started.append(Ros1(**{"master": stand.uri, "folders": [types], **arguments}))  # type: ignore[arg-type]
        return started[-1]

    yield start
    for graph in started:
        graph.close()


@pytest.fixture
def graph(start_ros1: StartRos1) -> Ros1:
    made = start_ros1()
    wait_until(lambda: not made.healthy, "the master knows of us")
    return made
