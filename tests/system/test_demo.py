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
