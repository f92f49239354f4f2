"""mypy and pyright, run over files of a test."""

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

CHECKERS: Final = {
    "mypy": ("-m", "mypy", "--strict", "--no-error-summary", "--cache-dir"),
    "pyright": ("-m", "basedpyright", "--level", "error", "--pythonpath", sys.executable, "--project"),
}


def checked(checker: str, files: Sequence[Path], folder: Path) -> tuple[list[tuple[str, int]], str]:
    """The lines that a checker calls wrong, by file name and number, and all that it says.

    Args:
        checker: a name of `CHECKERS`.
        files: the files to check.
        folder: an empty folder for its settings and its cache; modules beside it can be imported.
    """
    if checker == "pyright":
        settings = {"typeCheckingMode": "standard", "extraPaths": [str(folder.parent)]}
        (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    done = subprocess.run(
        [sys.executable, *CHECKERS[checker], str(folder), *map(str, files)],
        cwd=folder.parent,
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    found = re.findall(r"(\w+\.pyi?):(\d+):(?:\d+ -)? error", done.stdout)
    return sorted({(name, int(number)) for name, number in found}), done.stdout + done.stderr


def seeded(file: Path) -> list[tuple[str, int]]:
    """The lines of a file that are wrong on purpose: they have an "error" comment."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return [(file.name, number) for number, line in enumerate(lines, 1) if "# error:" in line]
