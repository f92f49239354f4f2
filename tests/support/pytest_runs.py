"""Runs of pytest of their own, with the plug-ins that are installed."""

import os
import subprocess
import sys
from pathlib import Path

__all__ = ["run_pytest"]


def run_pytest(folder: Path, text: str) -> str:
    """Runs a test module with the plug-ins that are installed, and returns what pytest says."""
    (folder / "test_one.py").write_text(text)
    options = "-q -p no:cacheprovider -p no:schemathesis -c /dev/null --rootdir ."
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", *options.split(), "test_one.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout
