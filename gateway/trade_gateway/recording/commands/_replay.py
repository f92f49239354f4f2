"""``trade replay``: repeats a recorded motion as a trajectory under a lock, and compares it with the recording."""

from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import where
from trade_gateway.recording import require
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import SELECT, TIMING, Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor

SECTION: Final = sections.RECORDINGS
PLACE: Final = 2
_WAIT_S: Final = 10.0


def replay(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="A recording.")],
    group: Annotated[
        str | None, typer.Option(rich_help_panel=SELECT, help="Group to move, if the recording has several.")
    ] = None,
    speed: Annotated[
        float,
        typer.Option(
            min=0.05, max=2.0, rich_help_panel=TIMING, help="Speed factor; 0.5 takes twice as long as the recording."
        ),
    ] = 1.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything and move nothing.")] = False,
    go_to_start: Annotated[
        bool, typer.Option("--go-to-start", help="First move slowly to the start of the recording.")
    ] = False,
    tolerance_rad: Annotated[
        float, typer.Option(min=0.0, metavar="RAD", help="Largest deviation in rad; above it, the exit code is 1.")
    ] = 0.1,
    as_json: Json = False,
) -> None:
    """Move a group of joints or an arm as recorded, and report the deviation.

    A motion beyond the limits of the robot file is refused before anything moves.
    A robot that is not at the start of the recording is refused, too. Ctrl-C stops the motion.

    For example: trade replay walk.mcap --group rosie.head --speed 0.5
    """
    require("mcap", "record")
    from trade_gateway.recording.commands import _replay_run as room  # noqa: PLC0415 - loads what the other commands do not need

    out = Output(as_json=as_json)
    motion = room.chosen(file, group)
    with visitor(context) as container:
        robot = room.Robot(container, motion, speed)
        far = robot.far_from_start()
        out.say(
            f"[bold]{escape(motion.group)}[/]: {robot.duration_s:.1f} s at speed {robot.speed:.2g}, within all limits"
        )
        if far and not (go_to_start or dry_run):
            raise room.not_at_start(motion.group, far)
        if dry_run:
            if far:
                out.say(escape(str(room.not_at_start(motion.group, far))))
            if out.as_json:
                out.data({"group": motion.group, "joints": motion.joints, "duration_s": robot.duration_s, "far": far})
            return
        with container.lock(where(group=motion.group), purpose=f"replay {file.name}", wait_s=_WAIT_S):
            if far:
                out.say("moving to the start of the recording")
                robot.go_to_start()
            found = robot.follow()
    if out.as_json:
        out.data(found)
    joints = zip(found.joints, found.greatest_by_joint_rad, found.rms_by_joint_rad, strict=True)
    for joint, greatest, rms in joints:
        out.say(f"  {escape(joint)}: at most {greatest:.3f} rad from the recording, {rms:.3f} rad rms")
    within = found.greatest_rad <= tolerance_rad
    verdict = "[bold green]as recorded[/]" if within else "[bold red]not as recorded[/]"
    out.say(f"{verdict}: at most {found.greatest_rad:.3f} rad off; {tolerance_rad:g} rad are allowed")
    if not within:
        raise typer.Exit(1)
