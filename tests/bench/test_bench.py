"""The bench runs and prints its lines; how fast anything is, is not this test's business."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests.bench._calls import up
from tests.bench._flood import FLOODS
from tests.bench._others import Rpyc
from tests.bench._scale import measure
from tests.system.networks import why_not

ROOT = Path(__file__).parents[2]


def targets(printed: str) -> list[str]:
    return [re.split("  | [0-9]+[.]", line)[0] for line in printed.splitlines() if "  target " in line]


def bench(*arguments: str, timeout_s: float = 100) -> str:
    command = [sys.executable, "-m", "tests.bench", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


PEERS = ("raw TCP", "bare zenoh pair", "TRADE ", "rpyc", "Pyro5", "gRPC")
SIZES = ("64 B", "4 KiB", "64 KiB", "2 MiB")


def test_the_bench_of_calls_prints_every_peer_and_every_target() -> None:
    printed = bench("calls", "-n", "3", "--rounds", "1")
    for peer in (*PEERS, "TRADE, local"):
        assert printed.count(f"\n{peer}") == len(SIZES)
    assert targets(printed) == [
        f"{size}: {what}" for size in SIZES for what in ("p50 / bare pair", "CPU / bare pair", "p50 / rpyc")
    ]


def test_the_bench_of_calls_in_flight_prints_every_peer_and_every_target() -> None:
    printed = bench("in-flight", "-n", "3", "--rounds", "1")
    for peer in (*PEERS, "TRADE, threads"):
        assert len(re.findall(rf"^{peer}[^:]*$", printed, re.MULTILINE)) == len(SIZES)
    assert targets(printed) == ["TRADE: rate / bare pair", "TRADE, threads: rate / bare pair"] * len(SIZES)


def test_the_bench_of_the_supervisor_prints_its_targets() -> None:
    printed = bench("supervisor", "--rounds", "1", "--idle", "1")
    assert targets(printed) == ["supervisor: % of a core", "crash to serving, s", "crash to serving / plain start"]


def test_a_peer_that_is_not_installed_is_named_and_skipped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Rpyc, "needs", "no_such_module")
    with up([Rpyc()]) as peers:
        assert peers == []
    assert capsys.readouterr().out == "rpyc: skipped, the module no_such_module is not installed\n"


def test_the_bench_of_local_calls_prints_its_targets() -> None:
    printed = bench("local", "-n", "3", "--rounds", "1")
    assert targets(printed) == ["local, strict: us a call", "local, not strict: us a call"]


def test_the_bench_of_the_registry_prints_its_targets() -> None:
    printed = bench("registry", "--services", "30", "--rounds", "1")
    assert targets(printed) == ["late joiner: s", "remote service: KiB", "find: us"]
    assert "missed up to" not in printed


def test_the_bench_of_locks_prints_its_targets() -> None:
    assert targets(bench("locks", "-n", "3", "--rounds", "1")) == ["lock and unlock / call", "checked / unchecked call"]


def test_the_bench_of_the_can_bus_prints_its_targets() -> None:
    printed = bench("can", "--rounds", "1", "--seconds", "0.5")
    assert targets(printed) == ["late at 500 Hz, 1 TPDO, %", "late at 400 Hz, 2 TPDO, %"]
    assert printed.count("late in an empty loop") == 2


def test_the_bench_of_a_whole_robot_prints_its_target() -> None:
    printed = bench("rosie", "--rounds", "2", "--seconds", "0.5")
    assert "legs 200 Hz" in printed
    lost = "; 0 of 1 rounds" in printed  # too busy a machine loses devices
    assert targets(printed) == ([] if lost else ["all drivers: % of a core"])


def test_the_bench_of_watching_prints_its_targets() -> None:
    printed = bench("watching", "-n", "3", "--rounds", "1", "--seconds", "0.3")
    assert targets(printed) == ["merged ticks, %", "another watched / none"]


def test_the_bench_of_audit_records_prints_its_targets() -> None:
    printed = bench("audit", "-n", "3", "--rounds", "1", "--seconds", "0.3")
    assert targets(printed) == ["p50: audit on / off", "p99: audit on / off", "records/s written"]


def test_the_bench_of_streams_prints_its_target() -> None:
    assert targets(bench("streams", "--rounds", "1", "--seconds", "0.1")) == ["five listeners / one"]


def test_the_bench_of_the_servo_bus_prints_its_targets() -> None:
    printed = bench("servo", "-n", "3", "--rounds", "1", "--seconds", "0.05")
    assert "156 bytes a cycle" in printed
    assert "190 bytes a cycle" in printed
    assert printed.count("target") == 3


def test_the_bench_of_the_Feetech_bus_prints_its_targets() -> None:
    printed = bench("feetech", "-n", "3", "--rounds", "1", "--seconds", "0.05")
    assert "142 bytes a cycle" in printed
    assert targets(printed) == ["Feetech sync / limit", "CPU at 100 Hz, Feetech"]


def test_the_bench_of_arms_prints_its_targets() -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
    printed = bench("arm", "--rounds", "1", "--seconds", "0.5")
    assert targets(printed) == ["set-points/s, driver", "set-points/s, bare library", "CPU of the driver, cores"]


@pytest.mark.timeout(300)
def test_the_bench_of_gateways_prints_every_pair_every_flood_and_every_target() -> None:
    if reason := why_not():
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)
    printed = bench("gateway", "-n", "3", "--rounds", "1", "--idle", "0.5", timeout_s=250)
    assert targets(printed) == [
        "idle gateway: RSS, MiB",
        "idle gateway: % of a core",
        *(f"{flood.name}: {what}" for flood in FLOODS for what in ("call p99 / none", "stop, ms")),
        "one gateway: p50 / direct",
        "one gateway: p50 / bare pair",
        "one, plain: p50 / bare, plain",
        "two gateways: p50 / direct",
        "one gateway, 32 in flight: /s",
    ]
    assert re.search(r"\d+ services known across it", printed)
    for flood in FLOODS:
        assert len(re.findall(rf"^{flood.name} .*[1-9]", printed, re.MULTILINE)) == 1


def test_the_bench_of_the_deadman_prints_every_way_to_end() -> None:
    printed = bench("deadman", "--rounds", "1")
    assert targets(printed) == ["killed in a call", "killed in a start", "frozen in a call", "frozen in a jog"]


def test_the_bench_of_many_containers_prints_its_targets() -> None:
    printed = bench("scale", "--containers", "4", "--idle", "0.2")
    ours = [
        "join, bytes each: most / least",
        "remote service: KiB of Python",
        "find: most / least",
        "lock: most / least",
    ]
    processes = [] if "processes: skipped" in printed else ["join, bytes: real / simulated"]
    assert targets(printed) == [*ours, *processes]


def test_a_stand_in_costs_what_a_container_costs() -> None:
    """So what is counted of a thousand, most of them stand-ins, is what a thousand containers would cost."""
    whole, others = measure(6), measure(6, whole=2)
    assert (whole.whole, others.whole) == (6, 2)
    assert (whole.join, whole.leave, whole.register) == (others.join, others.leave, others.register)
    assert (whole.beat, whole.lock, whole.services) == (others.beat, others.lock, others.services)
