"""The bench runs and prints its lines; how fast anything is, is not this test's business."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def bench(*arguments: str) -> str:
    command = [sys.executable, "-m", "tests.bench", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_bench_of_calls_prints_every_peer_and_every_target() -> None:
    printed = bench("calls", "-n", "3", "--rounds", "2")
    for peer in ("raw TCP", "bare zenoh pair", "TRADE ", "rpyc", "TRADE, local"):
        assert f"\n{peer}" in printed
    assert [line.split("  ")[0] for line in printed.splitlines() if "target" in line] == [
        "p50 / bare pair",
        "CPU / bare pair",
        "p50 / rpyc",
    ]


def test_the_bench_of_the_servo_bus_prints_its_targets() -> None:
    printed = bench("servo", "-n", "3", "--rounds", "1", "--seconds", "0.05")
    assert "156 bytes a cycle" in printed
    assert "190 bytes a cycle" in printed
    assert printed.count("target") == 3
