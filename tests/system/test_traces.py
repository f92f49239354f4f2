"""A call seen from its caller to the bytes on a servo's bus, over three processes; and the commands that show it."""

import json
import logging
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.system.conftest import Program, Rosie
from trade import Container, HookEvent, Trace, service, where
from trade_gateway.cli import app
from trade_hil_sim import read_log, writes

MIND = """
import logging, sys, threading
from trade import Container, Settings, service, where

class Mind:
    @service
    def look(self, angle_rad: float) -> float:
        with container.lock(where(group="rosie.neck.pan"), purpose="look"):
            logging.getLogger("trade").warning("looking at %.1f", angle_rad)
            return container.call(where(name="move_to", group="rosie.neck.pan"), angle_rad)

with Container(Settings.read(container="mind")) as container:
    container.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30)
    container.register(Mind(), "mind")
    print("{}", flush=True)
    threading.Event().wait(300)
"""


class Eye:
    @service(effect="read")
    def see(self, called: HookEvent) -> None: ...


@pytest.fixture
def mind(rosie_up: Callable[[], Rosie], run: Callable[..., Program], tmp_path: Path) -> Rosie:
    """A behaviour in a second process that moves rosie's head, in a first."""
    rosie = rosie_up()
    (tmp_path / "mind.py").write_text(MIND)
    run(tmp_path / "mind.py").json()
    return rosie


@pytest.fixture
def looked(mind: Rosie, start_container: Callable[..., Container]) -> Container:
    """A third process, this one, which has had it look, with a hook on the motor, while all are traced."""
    ui = start_container("ui")
    ui.register(Eye(), "eye")
    look = ui.find(where(name="look"), wait_s=30)
    ui.after_service(ui.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30), ui.find(where(name="see")))
    assert len(ui.set_tracing(True)) == 3
    assert look(0.3) == pytest.approx(0.3, abs=0.02)
    return ui


def _says(*words: str | Path, code: int = 0) -> str:
    """What a command prints; in this process, as each of its own takes a second to start."""
    ended = CliRunner().invoke(app, [str(word) for word in words])
    assert ended.exit_code == code, ended.output
    return ended.stdout


def _shape(trace: Trace) -> tuple[str, list[Any]]:
    return trace.service, [_shape(call) for call in trace.calls]


def test_one_id_leads_from_the_caller_through_lock_hook_and_nested_call_to_the_bytes(
    looked: Container, mind: Rosie
) -> None:
    [asked] = [span for span in looked.spans(container="ui") if span.service == "mind.look"]
    trace = looked.trace(asked.call_id)
    acquire, move, release = trace.calls
    assert _shape(trace) == (
        "mind.look",
        [("trade.acquire", []), ("rosie.neck.pan.move_to", [("eye.see", [])]), ("trade.release", [])],
    )
    assert len({span.container for span in (*trace.spans, *move.spans)}) == 3
    assert [line.text for line in trace.lines] == ["looking at 0.3"]
    assert acquire.began <= move.began <= release.began
    assert move.served is not None
    assert move.served.locks[0].startswith("look (")
    texts = [text for _, text in move.served.events]
    assert texts == ["rosie.neck.pan: wrote goal", "rosie.neck.pan: at rest"]
    times = [after_s for after_s, _ in move.served.events]
    assert 0 < times[0] < times[1] < move.served.took_s
    to_monotonic_s = time.monotonic() - time.time()
    wrote = writes(read_log(mind.log), device_id=1, register="goal_position", since=move.began + to_monotonic_s)
    assert wrote
    assert wrote[0].t < move.began + move.served.took_s + to_monotonic_s


def test_the_commands_show_the_tree_and_the_lines_in_it(looked: Container) -> None:
    [call_id] = [span["call_id"] for span in json.loads(_says("trace", "--json")) if span["service"] == "mind.look"]
    tree = json.loads(_says("trace", str(call_id), "--json"))
    assert [call["served"]["service"] for call in tree["calls"]][1] == "rosie.neck.pan.move_to"
    text = _says("trace", str(call_id))
    for part in ("mind.look", "rosie.neck.pan.move_to", "eye.see", "rosie.neck.pan: wrote goal", "looking at 0.3"):
        assert part in text
    assert f"looking at 0.3  (call {call_id})" in _says("logs", "--container", "mind")
    assert _says("logs", "--container", "mind", "--level", "error") == ""
    assert json.loads(_says("tracing", "off", "--container", "mind", "--json")) == ["mind"]
    assert "no such container is in this system" in str(
        CliRunner().invoke(app, ["tracing", "on", "--container", "moon"]).exception
    )


def test_a_call_that_deviates_from_the_learned_profile_is_reported(looked: Container, tmp_path: Path) -> None:
    [look] = [row for row in json.loads(_says("profile", "--json")) if row["service"] == "mind.look"]
    assert (look["calls"], look["errors"]) == (1, 0)
    learned = tmp_path / "usual.json"
    _says("profile", "--learn", learned)
    assert "no call deviates" in _says("profile", "--against", learned)
    looked.call(where(name="state", group="rosie.neck.pan"))
    odd = json.loads(_says("profile", "--against", learned, "--json", code=1))
    assert [(one["kind"], one["before"], one["after"]) for one in odd] == [("new", "mind.look", "rosie.neck.pan.state")]
    assert looked.trace(odd[0]["call_id"]).service == "rosie.neck.pan.state"
    assert looked.name in json.loads(_says("profile", "--watch", learned, "--json"))["watched"]
    for _ in range(2):
        looked.call(where(name="state", group="rosie.neck.pan"))
    events = json.loads(_says("containers", "--show", "events", "--json"))
    deviated = [(one["container"], one["about"]) for one in events if one["kind"] == "call_deviated"]
    assert deviated == [(looked.name, "rosie.neck.pan.state")]


def test_logs_are_followed(run: Callable[..., Program], start_container: Callable[..., Container]) -> None:
    start_container("talker")
    log = logging.getLogger("trade")
    log.warning("before it runs")
    follow = run("-m", "trade_gateway", "logs", "--follow", "--json", "--container", "talker")
    while follow.json()["text"] != "before it runs":  # whatever was logged in this process until then
        pass
    log.warning("while it runs")
    assert follow.json()["text"] == "while it runs"
    follow.signal(signal.SIGINT)
    assert follow.wait() == 130
