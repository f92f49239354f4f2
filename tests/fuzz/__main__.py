"""``python -m tests.fuzz --minutes 10``: all targets, one after the other, each for its share of the time.

With Atheris (the dependency group ``fuzz``) what is tried next is guided by coverage; without, by hypothesis. What
breaks a target is kept in its corpus as ``found-...``, where `make test` tries it; mend it, and commit both.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import hypothesis

GUIDED: Final = find_spec("atheris") is not None
_MOST_MB: Final = 2048
_LONGEST_S: Final = 20


def guided(name: str, seconds: int) -> None:
    """Fuzz one target in this process; ends it."""
    import atheris

    with atheris.instrument_imports(include=["trade", "trade_drivers", "trade_gateway", "trade_hil_sim"]):
        from tests.fuzz.targets import TARGETS
    target = TARGETS[name]
    with tempfile.TemporaryDirectory() as grown:
        options = [f"-max_total_time={seconds}", f"-rss_limit_mb={_MOST_MB}", f"-timeout={_LONGEST_S}"]
        options += [f"-artifact_prefix={target.folder}/found-", "-max_len=4096", "-verbosity=0", "-print_final_stats=0"]
        atheris.Setup([sys.argv[0], *options, grown, str(target.folder)], lambda data: _quietly(target.takes, data))
        atheris.Fuzz()


def _quietly(take: object, data: bytes) -> None:
    take(data)  # type: ignore[operator]


def unguided(name: str, seconds: int) -> None:
    """The same by hypothesis: changed messages of the corpus, until the time is over."""
    from tests.fuzz._changes import almost, understood, wrong_inside
    from tests.fuzz.targets import TARGETS

    target = TARGETS[name]
    corpus = [path.read_bytes() for path in target.corpus]
    values = [value for data in corpus for value in understood(data)]
    kinds = [almost(target, corpus), *([wrong_inside(values)] if values else [])]
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for kind in kinds:
            _round(target.takes, kind, target.folder)


def _round(take: object, kind: object, folder: Path) -> None:
    last = [b""]

    @hypothesis.settings(
        max_examples=500, deadline=None, database=None, suppress_health_check=list(hypothesis.HealthCheck)
    )
    @hypothesis.given(kind)  # type: ignore[arg-type]
    def tried(data: bytes) -> None:
        last[0] = data
        take(data)  # type: ignore[operator]

    try:
        tried()
    except Exception:
        folder.joinpath(f"found-{hashlib.sha256(last[0]).hexdigest()[:12]}").write_bytes(last[0])
        raise


def main() -> int:
    """Run as a program: each target in a process of its own, so that what kills one ends only that."""
    words = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    words.add_argument("--minutes", type=float, default=10.0, help="for all targets together")
    words.add_argument("--only", default="", help="targets whose names contain this")
    words.add_argument("--one", default="", help=argparse.SUPPRESS)
    words.add_argument("--seconds", type=int, default=0, help=argparse.SUPPRESS)
    given = words.parse_args()
    if given.one:
        (guided if GUIDED else unguided)(given.one, given.seconds)
        return 0
    from tests.fuzz.targets import TARGETS

    names = [name for name in TARGETS if given.only in name]
    seconds = max(1, round(given.minutes * 60 / max(1, len(names))))
    print(f"{len(names)} targets, {seconds} s each, {'guided by coverage (Atheris)' if GUIDED else 'by hypothesis'}")
    if not GUIDED:
        print("Atheris has no wheel for this Python or machine, or was not installed: uv sync --group fuzz")
    broken = [name for name in names if not _fuzzed(name, seconds)]
    print("broken: " + ", ".join(broken) if broken else "nothing broke")
    return bool(broken)


def _fuzzed(name: str, seconds: int) -> bool:
    began = time.monotonic()
    words = [sys.executable, "-m", "tests.fuzz", "--one", name, "--seconds", str(seconds)]
    with tempfile.TemporaryFile() as said:
        ended = subprocess.run(words, stdout=said, stderr=subprocess.STDOUT, check=False, env={**os.environ})
        said.seek(0)
        text = said.read().decode(errors="replace")
    print(f"{name:24} {time.monotonic() - began:6.1f} s  {'ok' if not ended.returncode else 'BROKEN'}", flush=True)
    if ended.returncode:
        print(text[-4000:], flush=True)
    return not ended.returncode


if __name__ == "__main__":
    sys.exit(main())
