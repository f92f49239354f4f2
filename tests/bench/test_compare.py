"""Two runs beside each other, and what is said to differ."""

import math
import sys
from pathlib import Path

import pytest

from tests.bench import compare
from tests.bench._record import NEVER, Machine, Point, Run, Spread, Target


def run_of(p50_us: list[float], *, met: bool = True, others_cores: float = 0.0) -> Run:
    spread = Spread.of(p50_us)
    return Run(
        machine=Machine("chip", 2, 8.0, "Linux", "CPython"),
        versions={},
        commit="abc",
        began="today",
        arguments=[],
        load_before=0.0,
        took_s=1.0,
        others_cores=others_cores,
        points=[Point("calls", "64 B", "TRADE", 100, {"p50, us": spread})],
        targets=[Target("calls", "64 B: p50", "at most 2", spread, met)],
    )


QUIET = [99.0, 100.0, 101.0, 100.0]
NOISY = [80.0, 100.0, 120.0, 140.0]


@pytest.mark.parametrize(
    ("old", "new", "differs"),
    [
        (QUIET, [109.0, 110.0, 111.0, 110.0], True),
        (QUIET, [90.0, 91.0, 89.0, 90.0], True),
        (QUIET, [100.5, 101.0, 100.5, 101.0], False),
        (QUIET, [x + 15 for x in NOISY], False),
        (NOISY, [x + 40 for x in NOISY], False),
        (NOISY, [x + 70 for x in NOISY], True),
        ([100.0, 100.0], [500.0, 500.0], False),
    ],
)
def test_only_what_lies_apart_by_more_than_the_spread_of_both_differs(
    old: list[float], new: list[float], differs: bool
) -> None:
    found = compare.figures(run_of(old), run_of(new))
    assert [one.differs for one in found] == [differs, differs]


def printed(capsys: pytest.CaptureFixture[str], folder: Path, old: Run, new: Run) -> str:
    for name, run in (("old", old), ("new", new)):
        run.write(folder / f"{name}.json")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["compare", str(folder / "old.json"), str(folder / "new.json")])
        compare.main()
    return capsys.readouterr().out


def test_the_table_has_both_figures_their_ratio_and_what_became_of_targets(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = printed(capsys, tmp_path, run_of(QUIET), run_of([x * 3 for x in QUIET], met=False))
    [line] = [line for line in said.splitlines() if line.startswith("calls: 64 B: TRADE: p50, us")]
    assert line.split()[-4:] == ["100", "300", "3.00", "differs"]
    assert "2 of 2 figures differ" in said
    assert said.endswith("calls: target 64 B: p50: missed now\n")
    assert "other programs" not in said


def test_runs_beside_other_programs_are_compared_with_a_warning(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert "other programs ran" in printed(capsys, tmp_path, run_of(QUIET), run_of(QUIET, others_cores=0.8))


def test_figures_of_one_run_alone_are_counted_and_not_compared(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    new = run_of(QUIET)
    new.targets.clear()
    assert "\nfigures in the old run only: 1\n" in printed(capsys, tmp_path, run_of(QUIET), new)


def test_what_is_written_is_read_back_and_what_never_came_is_a_number(tmp_path: Path) -> None:
    run = run_of([1.0, 2.0, math.inf, math.inf])
    run.write(tmp_path / "deep" / "run.json")
    again = Run.read(tmp_path / "deep" / "run.json")
    assert again == run
    assert again.points[0].values["p50, us"].most == NEVER
