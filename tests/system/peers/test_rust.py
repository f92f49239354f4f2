"""The container in Rust is built, tests itself with the vectors, and passes `trade conformance`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.rust_peer import built_peer, cargo
from trade_checks.conformance import CHECKS

LEFT_OUT = {"streams"}
"""What this small container does not do; nothing about safety."""

pytestmark = pytest.mark.timeout(1800)  # the transport is built from its sources: minutes on an idle machine


@pytest.fixture(scope="module")
def peer() -> Path:
    return built_peer()


def test_its_own_tests_pass_on_the_vectors(peer: Path) -> None:
    cargo("test")


def test_it_passes_every_mandatory_check(peer: Path) -> None:
    command = [sys.executable, "-m", "trade_gateway", "conformance", "--peer", str(peer), "--motion", "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    outcomes = [json.loads(line) for line in ended.stdout.splitlines()]
    assert {one["check"]: one["why"] for one in outcomes if one["outcome"] == "failed"} == {}
    assert {one["check"] for one in outcomes if one["outcome"] == "left out"} == LEFT_OUT
    assert [one["check"] for one in outcomes] == [one.name for one in CHECKS]
    assert ended.returncode == 0
