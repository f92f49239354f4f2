"""``python -m tests.endurance.fuzz --minutes 10``: all targets, one after the other, each for its share of the time.

With Atheris (the dependency group ``fuzz``) what is tried next is guided by coverage; without, by hypothesis. What
breaks a target is kept in its corpus as ``found-...``, where `make test-all` tries it; fix it, and commit both.
"""

import argparse
import hashlib
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NoReturn

import hypothesis

from tests.endurance.fuzz._changes import almost, understood, wrong_inside
from tests.endurance.fuzz._target import CORPUS, Target

GUIDED: Final = find_spec("atheris") is not None
_MOST_MB: Final = 2048
_LONGEST_S: Final = 20


def guided(names: list[str], seconds: int) -> list[str]:
    """Fuzz these; those that broke. The packages are instrumented once, and each target has a child of its own."""
    import atheris

    with atheris.instrument_imports(include=["trade", "trade_drivers", "trade_gateway", "trade_hil_sim"]):
        from tests.endurance.fuzz.targets import TARGETS
    return [name for name in names if not _in_a_child(name, lambda name=name: _guide(TARGETS[name], seconds))]


def _guide(target: Target, seconds: int) -> None:
    """Ends this process."""
    import atheris

    with tempfile.TemporaryDirectory() as grown:
        options = [f"-max_total_time={seconds}", f"-rss_limit_mb={_MOST_MB}", f"-timeout={_LONGEST_S}"]
        options += [f"-artifact_prefix={target.folder}/found-", "-max_len=4096", "-verbosity=0"]
        atheris.Setup([sys.argv[0], *options, grown, str(target.folder)], lambda data: _kept(target, data))
        atheris.Fuzz()


def _kept(target: Target, data: bytes) -> None:
    try:
        target.takes(data)
    except Exception:
        _keep(target.folder, data)
        raise


def _keep(folder: Path, data: bytes) -> None:
    folder.joinpath(f"found-{hashlib.sha256(data).hexdigest()[:12]}").write_bytes(data)


def unguided(names: list[str], seconds: int) -> list[str]:
    """The same by hypothesis: changed messages of the corpus, until the time is over."""
    from tests.endurance.fuzz.targets import TARGETS

    return [name for name in names if not _in_a_child(name, lambda name=name: _try(TARGETS[name], seconds))]


def _try(target: Target, seconds: int) -> None:
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
        _keep(folder, last[0])
        raise


def _in_a_child(name: str, work: Callable[[], None]) -> bool:
    """Whether it came to a good end; what it says is shown if not."""
    began = time.monotonic()
    with tempfile.TemporaryFile() as said:
        child = os.fork()
        if child == 0:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
            _ended(work)
        _, status = os.waitpid(child, 0)
        said.seek(0)
        text = said.read().decode(errors="replace")
    print(f"{name:24} {time.monotonic() - began:6.1f} s  {'BROKEN' if status else 'ok'}", flush=True)
    if status:
        print(text[-4000:], flush=True)
    return not status


def _ended(work: Callable[[], None]) -> NoReturn:
    code = 1
    try:
        work()
        code = 0
    except SystemExit as ended:
        code = int(bool(ended.code))
    except BaseException:  # noqa: BLE001 - it is shown
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def main() -> int:
    """Run as a program."""
    words = argparse.ArgumentParser(prog="python -m tests.endurance.fuzz", description=__doc__)
    words.add_argument("--minutes", type=float, default=10.0, help="for all targets together")
    words.add_argument("--only", default="", help="targets whose names contain this")
    given = words.parse_args()
    names = [path.name for path in sorted(CORPUS.iterdir()) if given.only in path.name]
    seconds = max(1, round(given.minutes * 60 / max(1, len(names))))
    print(f"{len(names)} targets, {seconds} s each, {'guided by coverage (Atheris)' if GUIDED else 'by Hypothesis'}")
    if not GUIDED:
        print("Atheris has no wheel for this Python or machine, or was not installed: uv sync --group fuzz")
    broken = (guided if GUIDED else unguided)(names, seconds)
    print("broken: " + ", ".join(broken) if broken else "nothing broke")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
