"""The container in Rust is built, tests itself with the vectors, and passes `trade conformance`."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from trade_gateway.conformance import CHECKS

CRATE = Path(__file__).parents[3] / "peers" / "rust"
TARGET = CRATE / "target"
LEFT_OUT = {"streams"}
"""What this small container does not do; nothing about safety."""

pytestmark = pytest.mark.timeout(1800)  # the transport is built from its sources: minutes on an idle machine


def _version(text: str) -> tuple[int, ...]:
    found = re.search(r"(\d+)\.(\d+)", text)
    assert found, text
    return tuple(map(int, found.groups()))


def _missing() -> str:
    """Why it cannot be built here."""
    cargo = shutil.which("cargo")
    if cargo is None:
        return "there is no cargo on this machine"
    reported = subprocess.run([cargo, "--version"], capture_output=True, text=True, timeout=60, check=False)
    [needed] = re.findall(r'^rust-version = "(.*)"$', (CRATE / "Cargo.toml").read_text(encoding="utf-8"), re.MULTILINE)
    if reported.returncode != 0 or _version(reported.stdout) < _version(needed):
        return f"cargo is too old, or does not run: {reported.stdout or reported.stderr}; this takes {needed}"
    return ""


def _cargo(*words: str) -> None:
    command = ["cargo", *words, "--locked", "--target-dir", str(TARGET)]
    ended = subprocess.run(command, cwd=CRATE, capture_output=True, text=True, timeout=1700, check=False)
    assert ended.returncode == 0, ended.stderr[-4000:] + ended.stdout[-4000:]


@pytest.fixture(scope="module")
def peer() -> Path:
    if reason := _missing():
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)
    _cargo("build")
    return TARGET / "debug" / ("trade-peer.exe" if os.name == "nt" else "trade-peer")


def test_its_own_tests_pass_on_the_vectors(peer: Path) -> None:
    _cargo("test")


def test_it_passes_every_mandatory_check(peer: Path) -> None:
    command = [sys.executable, "-m", "trade_gateway", "conformance", "--peer", str(peer), "--motion", "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    outcomes = [json.loads(line) for line in ended.stdout.splitlines()]
    assert {one["check"]: one["why"] for one in outcomes if one["outcome"] == "failed"} == {}
    assert {one["check"] for one in outcomes if one["outcome"] == "left out"} == LEFT_OUT
    assert [one["check"] for one in outcomes] == [one.name for one in CHECKS]
    assert ended.returncode == 0
