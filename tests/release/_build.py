"""Wheels and source archives, made twice from two copies of the repository: the same bytes, or it is an error."""

import os
import shutil
import subprocess
from hashlib import sha256
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
MEMBERS: Final = (".", "checks", "drivers", "gateway", "hil-sim", "robotfile")
"""Where the project files of the packages are."""
_NEEDED: Final = ("pyproject.toml", "uv.lock", "LICENSE", "trade", "pytest_trade", *MEMBERS[1:])
_LEFT_OUT: Final = shutil.ignore_patterns("__pycache__", "*.pyc", "build", "dist")


def commit_time() -> str:
    """Seconds since 1970 of what is checked out, for SOURCE_DATE_EPOCH; what the environment says goes first."""
    if said := os.environ.get("SOURCE_DATE_EPOCH"):
        return said
    asked = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=True)
    return asked.stdout.strip()


def build(uv: str, place: Path, into: Path, *, umask: int = 0o022) -> dict[str, str]:
    """Build all packages from a copy of the repository.

    Args:
        uv: the program.
        place: where the copy is made; it says nothing about what comes out.
        into: where wheels and archives go; emptied before.
        umask: of the copy's files.

    Returns:
        SHA-256 by file name.

    Raises:
        RuntimeError: it could not be built; with what uv said.
    """
    shutil.rmtree(into, ignore_errors=True)
    _copy(place, umask)
    built = subprocess.run(
        [uv, "build", "--all-packages", "--quiet", "--out-dir", into],
        cwd=place,
        env={**os.environ, "SOURCE_DATE_EPOCH": commit_time()},
        capture_output=True,
        text=True,
        check=False,
    )
    if built.returncode:
        raise RuntimeError(built.stderr)
    files = [path for path in into.iterdir() if path.suffix in (".whl", ".gz")]
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in sorted(files)}


def _copy(place: Path, umask: int) -> None:
    for name in _NEEDED:
        source, target = ROOT / name, place / name
        if source.is_dir():
            shutil.copytree(source, target, ignore=_LEFT_OUT, copy_function=shutil.copyfile)
        else:
            place.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
    for path in place.rglob("*"):
        path.chmod((0o777 if path.is_dir() else 0o666) & ~umask)
