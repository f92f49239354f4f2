import signal
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

LOOKER = Path(__file__).with_name("looker.py")


def test_a_loop_in_a_third_process_outlives_kill_9_of_its_robot(rosie_up, run) -> None:
    first = rosie_up()
    looker = run(LOOKER)
    before = looker.wait_for(lambda said: said["outcome"] == "ok")

    first.program.signal(signal.SIGKILL)
    # The calls' own deadline is a minute: what ends them is the loss of the container.
    failed = looker.wait_for(lambda said: said["outcome"] != "ok")
    assert failed["outcome"] in ("ServiceGone", "ContainerLost")

    rosie_up()
    after = looker.wait_for(lambda said: said["outcome"] == "ok")
    assert after["epoch"] != before["epoch"]


def test_a_frozen_robot_is_noticed_and_comes_back_by_itself(rosie_up, run) -> None:
    rosie = rosie_up()
    looker = run(LOOKER)
    before = looker.wait_for(lambda said: said["outcome"] == "ok")

    rosie.program.signal(signal.SIGSTOP)
    try:
        failed = looker.wait_for(lambda said: said["outcome"] != "ok")
        assert failed["outcome"] in ("ServiceGone", "ContainerLost")
    finally:
        rosie.program.signal(signal.SIGCONT)
    after = looker.wait_for(lambda said: said["outcome"] == "ok")
    assert after["epoch"] == before["epoch"]
