"""The Pythons of this machine that the packages are for: those on the PATH, those uv knows of, those of pyenv."""

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

MINORS: Final = ("3.10", "3.11", "3.12", "3.13")
_TELL: Final = "import sys; print(sys.implementation.name, '%d.%d.%d' % sys.version_info[:3], sys.executable)"


def pythons(uv: str) -> dict[str, Path]:
    """The newest of each minor version, by that version: ``{"3.12": Path("/usr/bin/python3.12")}``."""
    found: dict[str, tuple[tuple[int, ...], Path]] = {}
    for candidate in dict.fromkeys(_candidates(uv)):
        if (reported := _asked(candidate)) is None:
            continue
        version, path = reported
        minor = ".".join(map(str, version[:2]))
        if minor in MINORS:
            found[minor] = max(found.get(minor, (version, path)), (version, path), key=lambda one: one[0])
    return {minor: found[minor][1] for minor in MINORS if minor in found}


def _candidates(uv: str) -> Iterator[Path]:
    for folder in map(Path, os.environ.get("PATH", "").split(os.pathsep)):
        yield from (folder / f"python{minor}" for minor in MINORS if (folder / f"python{minor}").is_file())
    listed = subprocess.run(
        [uv, "python", "list", "--only-installed", "--output-format", "json"],
        capture_output=True,
        text=True,
        check=False,
    )
    yield from (Path(one["path"]) for one in json.loads(listed.stdout or "[]"))
    if pyenv := shutil.which("pyenv"):
        root = subprocess.run([pyenv, "root"], capture_output=True, text=True, check=False).stdout.strip()
        yield from sorted(Path(root).glob("versions/*/bin/python")) if root else ()


def _asked(python: Path) -> tuple[tuple[int, ...], Path] | None:
    """Version and path of a CPython; None of anything else. A shim (pyenv) names the one behind it, or fails."""
    try:
        reported = subprocess.run([python, "-c", _TELL], capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    name, version, path = reported.stdout.strip().split(" ", 2)
    return (tuple(map(int, version.split("."))), Path(path)) if name == "cpython" else None
