"""A robot's recording: killed, at a fault of its simulation."""

import json
import signal
from collections.abc import Callable
from pathlib import Path

from system.conftest import Bench, Program, Rosie
from trade_gateway.recording._reader import entries


def test_a_recording_whose_program_was_killed_is_readable_to_its_last_second(
    rosie_up: Callable[[], Rosie], run: Callable[..., Program], tmp_path: Path
) -> None:
    rosie_up()
    file = tmp_path / "a.mcap"
    recording = run("-m", "trade_gateway", "record", file, "--json")
    flushed = recording.wait_for(lambda line: line.get("messages", 0) > 50)
    recording.signal(signal.SIGKILL)
    assert recording.wait() == -signal.SIGKILL
    found = list(entries(file))
    assert len(found) >= flushed["messages"]
    assert {"/rosie.head/joints"} <= {entry.topic for entry in found}


def test_a_fault_in_the_simulator_saves_the_seconds_before_it(
    bench: Bench, run: Callable[..., Program], tmp_path: Path
) -> None:
    folder = tmp_path / "faults"
    recording = run("-m", "trade_gateway", "record", "--keep-last", "30", "--at-fault", folder, "--json")
    recording.wait_for(lambda line: line.get("messages", 0) > 100)
    bench.sim.control.unplug("neck")
    saved = recording.wait_for(lambda line: "saved" in line)
    assert saved["messages"] > 50
    found = list(entries(Path(saved["saved"])))
    assert len([entry for entry in found if entry.topic == "/rosie.head/joints"]) > 50
    fault = json.loads(found[-1].data)
    assert found[-1].topic == "/faults"
    assert fault["new"]
    assert saved["why"] == f"{fault['about']}: {fault['text']}"
