"""The example of a behaviour on virtual time: ten minutes with a brown-out in the middle, as the page shows it."""

import importlib
import re
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from pytest_trade_hil_sim.robots import SimulatedRobot, StartRobot
from tests.support.pytest_runs import run_pytest
from trade.testing import VirtualTime

EXAMPLES: Final = Path(__file__).parents[3] / "examples"
MODULES: Final = ("lookout", "test_lookout")


def _imported() -> Any:
    sys.path.insert(0, str(EXAMPLES))
    try:
        return importlib.import_module("test_lookout")
    finally:
        sys.path.remove(str(EXAMPLES))


story = _imported()
robot, lookout = story.robot, story.lookout
test_after_a_brown_out_it_waits_for_a_person_and_continues = (
    story.test_after_a_brown_out_it_waits_for_a_person_and_continues
)


@pytest.fixture
def simulated_robot(simulated_robot: StartRobot) -> StartRobot:
    """Finds robot files where a user of the example has them: beside the test."""

    def start(robot_file: str | Path, *, rate_hz: float | None = None) -> SimulatedRobot:
        return simulated_robot(EXAMPLES / robot_file, rate_hz=rate_hz)

    return start


@pytest.fixture(autouse=True)
def _virtual(request: pytest.FixtureRequest) -> Iterator[None]:
    clock, began_s = VirtualTime.current(), time.process_time()
    if clock is None and request.node.get_closest_marker("virtual_time"):
        pytest.skip("it lasts ten minutes on the real clock")
    yield
    if clock is not None:
        print(f"{clock.elapsed_s:.0f} s took {time.process_time() - began_s:.2f} s of the processor")


@pytest.mark.virtual_time(seed=1, packages=MODULES)
def test_a_lookout_that_enables_by_itself_fails_the_test_of_the_example(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = story.Lookout._try

    def enable_and_look(lookout: Any, goal: list[float]) -> str:
        if lookout.problem:
            lookout._robot.robot("rosie").head.enable()
        return str(looks(lookout, goal))

    monkeypatch.setattr(story.Lookout, "_try", enable_and_look)
    devices = [request.getfixturevalue(name) for name in ("robot", "lookout")]
    with pytest.raises(AssertionError, match=r"rosie\.neck\.pan"):
        test_after_a_brown_out_it_waits_for_a_person_and_continues(*devices)


def test_the_page_shows_the_example() -> None:
    page = (EXAMPLES.parent / "docs" / "testing.md").read_text(encoding="utf-8")
    [shown] = re.findall(r'```python title="test_lookout.py"\n(.*?)```', page, re.DOTALL)
    assert (EXAMPLES / "test_lookout.py").read_text(encoding="utf-8").endswith(shown)


@pytest.mark.realtime
def test_a_user_runs_the_example(tmp_path: Path) -> None:
    for name in ("lookout.py", "head.toml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    assert "1 passed" in run_pytest(tmp_path, (EXAMPLES / "test_lookout.py").read_text(encoding="utf-8"))
