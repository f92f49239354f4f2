"""What has to hold before wheels are given away: they are left in dist/, with hashes and what licences they need.

Wheels and source archives are built twice, from two copies, and must be the same bytes. Then, on each Python 3.10 to
3.13 of this machine: an environment of its own, the core installed alone, all five packages with what their ranges
bring today, and tests of this folder run against what is installed. --whole runs the whole suite there instead of a
part; --only 3.12 tries one Python. The end is 1 if anything failed.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Final

from tests.release import _build, _licences
from tests.release._pythons import MINORS, pythons
from tests.release._trial import QUICK, Failed, Trial

DIST: Final = _build.ROOT / "dist"
UV: Final = os.environ.get("UV", "uv")
"""`uv run` says which it is."""


def main() -> int:
    """Build, compare, try."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=MINORS, help="this Python; repeatable")
    parser.add_argument("--whole", action="store_true", help="run the whole suite on each")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="trade-release-") as folder:
        if not _built(Path(folder)):
            return 1
        found = pythons(UV)
        for minor in MINORS:
            if minor not in found:
                print(f"{minor}: no such Python on this machine, so it is not tried", flush=True)
        wanted = {minor: path for minor, path in found.items() if minor in (words.only or MINORS)}
        failed = [one for one, path in wanted.items() if not _tried(one, path, Path(folder), words.whole)]
    print(
        f"failed: {', '.join(failed)}" if failed else f"dist/ holds what passed on {', '.join(wanted) or 'no Python'}"
    )
    return int(bool(failed) or not wanted)


def _built(folder: Path) -> bool:
    try:
        first = _build.build(UV, folder / "one", DIST)
        second = _build.build(UV, folder / "another" / "place", folder / "dist", umask=0o077)
    except RuntimeError as error:
        print(f"not built: {error}")
        return False
    if first != second:
        print(f"not reproducible: {', '.join(sorted(name for name in first if first[name] != second.get(name)))}")
        return False
    (DIST / "SHA256SUMS").write_text("".join(f"{hash_}  {name}\n" for name, hash_ in first.items()), encoding="utf-8")
    print(f"built twice, the same bytes: {len(first)} files, as of {_build.commit_time()} s", flush=True)
    return True


def _tried(minor: str, python: Path, folder: Path, whole: bool) -> bool:
    place = folder / minor
    place.mkdir()
    try:
        trial = Trial(UV, python, DIST, place)
        trial.core_alone()
        version = trial.all()
        lines = trial.licences()
        (DIST / f"licences-{minor}.tsv").write_text(lines, encoding="utf-8")
        rows = [line.split("\t") for line in lines.splitlines()]
        if wrong := _licences.not_permissive((name, said) for name, _, said in rows):
            raise Failed("licences to look at: " + "; ".join(wrong))
        print(f"{minor} ({python}): installed, {version}, {len(rows)} packages with permissive licences", flush=True)
        print(f"{minor}: {trial.tests(('tests',) if whole else QUICK)}", flush=True)
    except Failed as error:
        print(f"{minor} ({python}): {error}", flush=True)
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
