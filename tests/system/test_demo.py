"""``make demo``: the story is told to its end on both kinds of networks, and nothing is left of it."""

import re
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from doors import Client
from system.conftest import ROOT, Program
from system.networks import ip, why_not
from waiting import wait_until

pytestmark = pytest.mark.timeout(300)

DEMO = ROOT / "examples" / "demo.py"
Run = Callable[..., Program]


def told(demo: Program, until: str) -> str:
    """What it says, up to these words."""
    story = ""
    while until not in story:
        story += demo.line()
    return story


def left_of(story: str) -> list[str]:
    """Folders and namespaces that a demo named and that are still there."""
    named = set(re.findall(r"trade-demo-[\w-]+", story))
    assert named
    there = {path.name for path in Path(tempfile.gettempdir()).iterdir()}
    there |= set() if why_not() else {line.split()[0] for line in ip("netns", "list").splitlines() if line}
    return sorted(named & there)


def test_rosie_walks_through_a_gateway_between_two_networks(run: Run) -> None:
    if reason := why_not():
        pytest.skip(reason)
    demo = run(DEMO)
    story = told(demo, "agrees with what the devices did")
    assert demo.wait() == 0, demo.errors
    assert "The networks are network namespaces" in story
    assert "has the legs, for 'walk'" in story
    assert sorted(re.findall(r"(\w+) +process \d+ was killed", story)) == ["head", "lamp"]
    assert sorted(re.findall(r"(\w+) +is served again", story)) == ["head", "lamp"]
    assert "0 writes that could move it; neck.pan at +0.3" in story
    assert "the new lamp shines at 0.7" in story
    assert left_of(story) == []


def test_rosie_walks_through_gateways_on_loopback_addresses(run: Run) -> None:
    demo = run(DEMO, "--loopback")
    story = told(demo, "agrees with what the devices did")
    assert demo.wait() == 0, demo.errors
    assert "loopback addresses of this host, as you said --loopback" in story
    assert "has the legs, for 'walk'" in story


def test_the_demo_fails_when_the_simulator_is_muted(run: Run) -> None:
    demo = run(DEMO, "--mute")
    story = told(demo, "no longer answer")
    assert demo.wait() == 1
    said = "".join(demo.errors)
    assert "the demo failed" in said
    assert "DeviceSilent" in said
    assert why_not() or left_of(story) == []


def test_a_demo_that_stays_shows_a_page_ends_with_ctrl_c_and_leaves_nothing(run: Run) -> None:
    demo = run(DEMO, "--stay")
    story = told(demo, "the head turns while you do")
    [url], [token] = re.findall(r"in a browser: (\S+)", story), re.findall(r"token: (\S+)", story)
    anna = Client(url, token)
    assert anna.ask("GET", "/").status == 200
    wait_until(lambda: anna.ask("GET", "/services?group=rosie.neck.pan&name=set_velocity").body, "rosie is seen")
    demo.signal(signal.SIGINT)
    assert demo.wait() == 0, demo.errors
    rest = "".join(demo.lines())
    assert "was killed" not in rest
    assert "Done in" in rest
    assert left_of(story) == []


def test_a_demo_that_is_ended_in_the_middle_leaves_nothing(run: Run) -> None:
    demo = run(DEMO, "--stay")
    story = told(demo, "Two behaviours want the same head")
    demo.signal(signal.SIGTERM)
    assert demo.wait() == 130, demo.errors
    assert why_not() or left_of(story) == []
