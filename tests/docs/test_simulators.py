"""The program of docs/simulators.md, run unchanged."""

import shutil
import time
from pathlib import Path

import pytest

from tests.docs.blocks import DOCS, ROOT, of, said, sections
from tests.docs.conftest import Play
from trade_drivers import attach, load

PAGE = "simulators.md"


def test_every_program_of_the_page_is_run() -> None:
    assert sections(iter([DOCS / PAGE]), "python") == said(globals())


@pytest.mark.realtime
@of(PAGE, "Run it")
def test_a_simulator_in_a_program(play: Play, tmp_path: Path) -> None:
    (tmp_path / "examples").mkdir()
    shutil.copy(ROOT / "examples" / "head.toml", tmp_path / "examples")

    def drive(port: str) -> None:
        robot = load("examples/head.toml")
        with attach(robot, announced=False, ports={"neck": port}) as rosie:
            rosie.motor("neck.pan").move_to(0.2)
        play.module.deadline = time.monotonic()

    play.run(drive=drive)
