"""Builds the container in Rust, `peers/rust`."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

CRATE = Path(__file__).parents[2] / "peers" / "rust"
TARGET = CRATE / "target"


class BuildError(Exception):
    """The compiler failed; with what it said."""


def built_peer() -> Path:
    """Builds it unless it is built, and returns its program; skips without cargo, and fails there in CI."""
    if reason := _missing():
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)
    cargo("build")
    return TARGET / "debug" / ("trade-peer.exe" if os.name == "nt" else "trade-peer")


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


def cargo(*words: str) -> None:
    nice = ["nice", "-n", "10"] if shutil.which("nice") else []  # the tests beside it have devices with deadlines
    command = [*nice, "cargo", *words, "--locked", "--target-dir", str(TARGET)]
    ended = subprocess.run(command, cwd=CRATE, capture_output=True, text=True, timeout=1700, check=False)
    if ended.returncode != 0:
        raise BuildError(ended.stderr[-4000:] + ended.stdout[-4000:])
