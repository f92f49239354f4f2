import signal
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_demo_tells_its_story(run) -> None:
    demo = run(ROOT / "examples" / "demo.py")
    assert demo.wait() == 0, demo.errors


def test_the_demo_fails_when_the_simulator_is_muted(run) -> None:
    demo = run(ROOT / "examples" / "demo.py", "--mute")
    assert demo.wait() == 1
    assert "the demo failed" in "".join(demo.errors)
    assert "DeviceSilent" in "".join(demo.errors)


def test_a_demo_that_stays_ends_with_ctrl_c_and_brings_nothing_up_again(run) -> None:
    demo = run(ROOT / "examples" / "demo.py", "--stay")
    while "Ctrl-C here ends it" not in demo.line():
        pass
    demo.signal(signal.SIGINT)
    assert demo.wait() == 0, demo.errors
    rest = "".join(demo.lines())
    assert "the robot is back" not in rest
    assert "done in" in rest
