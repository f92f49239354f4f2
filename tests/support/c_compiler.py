"""C libraries that tests make of their sources."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest


def library(source: Path, made: Path) -> Path:
    """Compile one; skips where there is no compiler, and fails there in CI."""
    compiler = shutil.which("cc")
    if compiler is None:
        reason = "there is no C compiler (Debian: apt-get install gcc libc6-dev)"
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)
    words = [compiler, "-shared", "-fPIC", "-O2", "-Wall", "-Werror", "-o", made, source]
    subprocess.run(words, check=True, timeout=100)
    return made
