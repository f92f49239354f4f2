"""The page on speed and its pictures say all that a run has; the committed ones are what the committed run gives."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.bench import page
from tests.bench._plots import figure
from tests.bench._plots import page as html
from tests.bench._record import NEVER, Machine, Point, Run, Skipped, Spread, Target
from tests.bench.page import DOCS, Bound, Reason, Why, files, read_why

FAST, SLOW = Spread.of([9.0, 10.0, 11.0]), Spread.of([123.0, 456.0, 789.0])


def a_run(**changes: object) -> Run:
    run = Run(
        machine=Machine("some chip", 2, 7.5, "Linux 6", "CPython 3.11"),
        versions={"eclipse-zenoh": "1.2.3"},
        commit="abcdef",
        began="2026-11-22 10:00 UTC",
        arguments=["--full"],
        load_before=0.25,
        load_after=1.75,
        took_s=600.0,
        others_cores=0.02,
        points=[
            Point("calls", "remote call of 64 B", "raw <TCP>", 2000, {"p50, us": FAST, "p99, us": SLOW}),
            Point("calls", "remote call of 64 B", "TRADE", 2000, {"p50, us": SLOW, "CPU / bare": FAST}),
            Point("can", "500 Hz, 1 TPDO", "empty loop", 8, {"late, %": Spread.of([0.0])}),
            Point("can", "500 Hz, 1 TPDO", "six drives", 9, {"late, %": Spread.of([0.5])}),
            Point("rosie", "on their way", "all drivers", 7, {"% of a core": FAST}),
        ],
        targets=[
            Target("calls", "64 B: p50 / bare pair", "at most 1.3", Spread.of([1.1, 1.2]), True),
            Target("calls", "64 B: p50 / rpyc", "below 1", Spread.of([2.5]), False),
            Target("calls", "64 B: p50 / Pyro5", "below 0.5", Spread.of([3.5]), False),
            Target("can", "late at 500 Hz, 1 TPDO, %", "below 1", Spread.of([NEVER]), False),
        ],
        skipped=[Skipped("arm", "arm", "ur-rtde is not installed")],
    )
    for name, value in changes.items():
        setattr(run, name, value)
    return run


WHY = Why((Reason(("64 B: p50 / rpyc", "64 B: p50 / Pyro5"), "Six threads wake up for a call.", "One thread less."),))


def test_the_page_has_every_target_every_figure_and_what_was_not_measured() -> None:
    run = a_run()
    text = page.written(run, WHY)
    for target in run.targets:
        [row] = [line for line in text.splitlines() if line.startswith(f"| {target.part} | {target.name} |")]
        assert row.endswith("| met |" if target.met else "| **missed** |")
    for point in run.points:
        [row] = [line for line in text.splitlines() if line.startswith(f"| {point.name} | {figure(point.n)} |")]
        assert all(figure(spread.median) in row for spread in point.values.values())
    assert "## Targets: 1 met, 3 missed" in text
    assert "| arm | arm | ur-rtde is not installed |" in text
    assert "never" in text
    for fact in ("some chip", "eclipse-zenoh 1.2.3", "commit abcdef", "--full", "load average 0.25 before, 1.75 after"):
        assert fact in text


def test_targets_missed_for_one_reason_are_listed_together_and_those_without_one_are_marked() -> None:
    text = page.written(a_run(), WHY)
    _, _, missed = text.partition("### Missed, and why")
    missed, _, _ = missed.partition("\n## ")
    assert missed.count("Six threads wake up for a call.\n\nTried: One thread less.") == 1
    assert "**64 B: p50 / rpyc; 64 B: p50 / Pyro5**" in missed
    assert "**late at 500 Hz, 1 TPDO, %**\n\nThere is no explanation yet." in missed
    assert "bare pair" not in missed


def test_a_bound_names_the_targets_that_it_replaced_where_its_own_were_measured() -> None:
    here = Bound(("64 B: p50 / raw TCP at most 1.4",), ("64 B: p50 / bare pair",), "Nothing is faster.")
    elsewhere = Bound(("2 MiB",), ("not in this run",), "Nothing.")
    text = page.written(a_run(), Why(bound=(here, elsewhere)))
    _, _, bounds = text.partition("### Targets that a bound replaced\n\n")
    bounds, _, _ = bounds.partition("\n### ")
    now = "**Asked: 64 B: p50 / raw TCP at most 1.4. Now: 64 B: p50 / bare pair**"
    assert bounds == f"{now}\n\nNothing is faster.\n"


@pytest.mark.parametrize(
    ("others_cores", "said"), [(0.02, "was quiet"), (0.8, "**not quiet**"), (None, "unknown part")]
)
def test_the_page_says_whether_other_programs_ran(others_cores: float | None, said: str) -> None:
    assert said in page.written(a_run(others_cores=others_cores), Why())


def test_pictures_show_every_point_in_order_and_stay_within_their_frame() -> None:
    drawn = files(a_run(), Why())["pictures/performance-calls.svg"]
    root = ET.fromstring(drawn)
    _, _, width, height = (float(one) for one in root.attrib["viewBox"].split())
    dots = [(float(one.attrib["cx"]), one.attrib["r"]) for one in root.iter("{http://www.w3.org/2000/svg}circle")]
    assert all(0 < x < width for x, _ in dots)
    (fast, _), (ring, _), (slow, _) = dots
    assert fast < slow == ring  # the p99 of one is the p50 of the other here
    assert all(0 < float(one.attrib["y"]) < height for one in root.iter("{http://www.w3.org/2000/svg}text"))
    assert {"raw <TCP>", "TRADE", "456", "10"} <= set(root.itertext())


def test_the_page_of_plots_has_all_parts_and_needs_nothing_from_elsewhere() -> None:
    text = html(a_run())
    assert text.count("<svg") == 2
    assert "<h2>rosie" not in text  # a figure alone is no plot
    assert "raw &lt;TCP&gt;" in text
    assert "1 met, 3 missed" in text
    assert not re.search(r"<script|src=|href=|url\(", text)


def test_the_page_in_docs_is_what_the_run_beside_it_gives() -> None:
    run = Run.read(DOCS / "performance.json")
    for name, text in files(run, read_why()).items():
        assert (DOCS / name).read_text() == text, f"{name}: make bench-page"


def test_targets_and_points_have_names_of_their_own_as_reasons_and_comparisons_go_by_them() -> None:
    run = Run.read(DOCS / "performance.json")
    targets = [target.name for target in run.targets]
    points = [(point.part, point.case, point.name) for point in run.points]
    assert len(set(targets)) == len(targets)
    assert len(set(points)) == len(points)


def test_the_command_writes_the_page_and_names_missed_targets_without_a_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a_run().write(tmp_path / "run.json")
    monkeypatch.setattr("sys.argv", ["page", "--json", str(tmp_path / "run.json"), "--to", str(tmp_path)])
    why = Why((*WHY.reason, Reason(("64 B: p50 / Viam SDK",), "It is slow.", "Nothing.")))
    monkeypatch.setattr(page, "read_why", lambda: why)
    page.main()
    assert (tmp_path / "performance.md").read_text() == page.written(a_run(), why)
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "missed without an explanation in why.toml: late at 500 Hz, 1 TPDO, %",
        "explained in why.toml, and not in this run: 64 B: p50 / Viam SDK",
    ]


def test_parts_measured_again_replace_the_earlier_ones_and_the_page_says_so() -> None:
    newer_run = a_run(
        commit="fedcba",
        arguments=["can", "servo"],
        others_cores=0.5,
        points=[Point("can", "500 Hz, 1 TPDO", "empty loop", 5, {"late, %": Spread.of([0.25])})],
        targets=[Target("can", "late at 500 Hz, 1 TPDO, %", "below 1", Spread.of([0.25]), True)],
        skipped=[Skipped("servo", "servo", "it failed")],
    )
    both = a_run().amended(newer_run)
    assert list(both.parts()) == list(a_run().parts())
    assert [one for one in both.points if one.part != "can"] == [one for one in a_run().points if one.part != "can"]
    assert [one for one in both.points if one.part == "can"] == newer_run.points
    assert [one.met for one in both.targets] == [True, False, False, True]
    assert Skipped("servo", "servo", "it failed") in both.skipped
    text = files(both, Why())["performance.md"]
    assert "**Measured again**: can, servo; 2026-11-22 10:00 UTC, commit fedcba, while" in text
    once_more = both.amended(
        a_run(arguments=["servo"], points=[], targets=[], skipped=[Skipped("servo", "servo", "x")])
    )
    assert [one.parts for one in once_more.again] == [("can", "servo"), ("servo",)]
    assert [one.reason for one in once_more.skipped if one.part == "servo"] == ["x"]
    assert [one.parts for one in both.amended(newer_run).again] == [("can", "servo")]
