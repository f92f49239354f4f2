"""``trade drill ROBOT.toml``: removes what a moving robot depends on, and measures how long it takes to stop."""

import platform
import signal
import tempfile
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer
from rich.markup import escape

from trade.errors import ConfigurationError
from trade_checks._cases import chosen
from trade_checks.drill import SCENES, Report, SceneReport, as_data, page, play, standing, targets_of
from trade_drivers import load, without
from trade_gateway._usage import UsageError
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output

SECTION: Final = sections.HARDWARE
_COLOURS = {True: "green", False: "bold red"}


def drill(
    robot_file: Annotated[
        Path | None, typer.Argument(metavar="ROBOT.toml", help="Robot file; its table \\[drill] has the limits.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="SCENE", help="Play only this scene. Repeatable.")] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder to write drill.json and drill.html to.")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the scenes and exit.")] = False,
    as_json: Json = False,
) -> None:
    """Check that a simulated robot stops when any part it depends on fails.

    The drill kills, freezes and disconnects one part after the other. No hardware is touched.
    One joint or arm of each bus moves, across two gateways. The simulator's log shows when it came to rest.
    The exit code is 1 if that took longer than the limit in \\[drill] of the robot file (docs/drill.md).

    For example: trade drill examples/head.toml --report .
    """
    out = Output(as_json=as_json)
    if listed:
        _list(out)
        return
    if robot_file is None:
        raise UsageError(where="ROBOT.toml", problem="missing; name a robot file, or --list the scenes")
    scenes = chosen(SCENES, only or [], "scene")
    robot = load(robot_file)
    targets, left_out = targets_of(robot)
    if not targets:
        raise ConfigurationError(where=robot.where, problem="it has no device that a drill can move")
    without(robot, left_out)  # raises if that is impossible
    for part, why in left_out.items():
        out.say(f"[bold]{robot.name}[/]: {escape(part)} is left out: {escape(why)}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that no process is left behind, frozen or not
    impossible = {
        scene.name: "it concerns no device that moves here" for scene in scenes if not any(map(scene.concerns, targets))
    }
    played: list[SceneReport] = []
    with tempfile.TemporaryDirectory(prefix="trade-drill-") as folder:
        out.say(f"[bold]{robot.name}[/]: moving {', '.join(target.name for target in targets)}, simulated")
        with standing(robot, targets, list(left_out), Path(folder)) as stand:
            for scene in scenes:
                if scene.name not in impossible:
                    played.append(play(stand, scene, targets, robot.drill))
                    _print(out, played[-1])
    found = Report(
        robot=robot.name,
        file=robot.where,
        version=version("trade-gateway"),
        host=platform.node(),
        at=datetime.now().astimezone().isoformat(timespec="seconds"),
        scenes=played,
        left_out={**left_out, **impossible},
    )
    if report is not None:
        _write(report, found)
    if as_json:
        out.data(as_data(found))
    _conclude(out, found, report)
    if not found.ok:
        raise typer.Exit(1)


def _list(out: Output) -> None:
    if out.as_json:
        out.data([{"scene": scene.name, "what": scene.what, "shows": scene.shows} for scene in SCENES])
        return
    out.table(("SCENE", "WHAT IS DONE", "SHOWS"), [(scene.name, scene.what, scene.shows) for scene in SCENES])


def _print(out: Output, played: SceneReport) -> None:
    out.say(f"{played.scene}: {escape(played.what)}")
    for problem in played.problems:
        out.say(f"  [{_COLOURS[False]}]not held[/]: {escape(problem)}")
    for stop in played.stops:
        ok = stop.verdict == "ok"
        motion = f"moved for {stop.took_s:.3f} s" if stop.took_s is not None else "was still moving"
        out.say(f"  {stop.joint:<20} {motion}, limit {stop.limit_s:.3f} s  [{_COLOURS[ok]}]{stop.verdict}[/]")


def _write(folder: Path, found: Report) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "drill.json").write_bytes(msgspec.json.format(msgspec.json.encode(as_data(found)), indent=2))
        (folder / "drill.html").write_text(page(found), encoding="utf-8")
    except OSError as problem:
        raise ConfigurationError(where=f"--report {folder}", problem=f"cannot be written: {problem.strerror}") from None


def _conclude(out: Output, found: Report, folder: Path | None) -> None:
    if folder is not None:
        out.say(f"the report is {escape(str(folder / 'drill.html'))}")
    failed = [played for played in found.scenes if not played.ok]
    for played in failed:
        bad = ", ".join(f"{stop.joint} {stop.verdict}" for stop in played.stops if stop.verdict != "ok")
        out.say(f"[bold red]failed[/]: {played.scene}: {escape(bad or 'could not be held')}")
    if found.ok:
        out.say(f"[bold green]passed[/]: {len(found.scenes)} scenes, all within their limits")
    elif not failed:
        out.say("[bold red]failed[/]: this robot can play no scene")
