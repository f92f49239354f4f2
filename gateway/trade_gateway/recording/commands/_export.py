"""``trade export``: writes a recording as a dataset of episodes for machine learning, or as a bag of ROS 2."""

from collections.abc import Collection
from enum import Enum
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.recording import require
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain

SECTION: Final = sections.RECORDINGS
PLACE: Final = 3
_DATASET: Final = "LeRobot dataset"


class ExportFormat(str, Enum):
    """What a recording becomes."""

    LEROBOT = "lerobot"
    ROS2 = "ros2"


class Names(str, Enum):
    """What joints are called in ROS."""

    LAST = "last"
    FULL = "full"


class EpisodeBoundary(str, Enum):
    """How a recording is cut into episodes."""

    WHOLE = "whole"
    LOCKS = "locks"


def export(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="A recording.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="New or empty folder for the dataset or the bag.")],
    form: Annotated[
        ExportFormat, typer.Option("--as", help="lerobot: a dataset; ros2: a bag in MCAP.")
    ] = ExportFormat.LEROBOT,
    group: Annotated[
        list[str] | None, typer.Option(help="Export only these joints, arm or gripper. Repeatable. Default: all.")
    ] = None,
    fps: Annotated[
        int, typer.Option(rich_help_panel=_DATASET, min=1, max=1000, metavar="HZ", help="Frame rate, in Hz.")
    ] = 30,
    cut: Annotated[
        EpisodeBoundary,
        typer.Option(
            "--episodes", rich_help_panel=_DATASET, help="whole: one episode; locks: one per lock of the joints."
        ),
    ] = EpisodeBoundary.WHOLE,
    task: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=_DATASET, help="Description of the task. Default: the lock's purpose, or the file's name."
        ),
    ] = None,
    names: Annotated[
        Names, typer.Option(rich_help_panel="Bag of ROS 2", help="Names of joints. last: pan; full: rosie.neck.pan.")
    ] = Names.LAST,
    as_json: Json = False,
) -> None:
    """Export a recording as a LeRobot dataset (v3.0), or as a bag of ROS 2.

    The dataset has the joints as Parquet tables, without pictures.
    observation.state is the measured angle in rad, or the width of a gripper in m; action is that of the next frame.
    The bag has /joint_states and the pictures of all cameras. It has neither calls nor locks nor faults.

    For example: trade export walk.mcap walk/ --group rosie.legs --episodes locks --fps 30
    """
    _refuse_others(context, form)
    out = Output(as_json=as_json)
    if form is ExportFormat.ROS2:
        _export_bag(out, file, folder, group, names)
    else:
        _export_dataset(out, file, folder, group, fps, cut, task)


_ONLY: Final = {ExportFormat.LEROBOT: ("fps", "cut", "task"), ExportFormat.ROS2: ("names",)}
"""Options that only one form has."""


def _refuse_others(context: typer.Context, form: ExportFormat) -> None:
    options = {option.name: option.opts[0] for option in context.command.params}
    for other, names in _ONLY.items():
        for name in names if other is not form else ():
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                problem = f"is only for --as {other.value}. Leave it out, or use --as {other.value}"
                raise UsageError(where=options[name], problem=problem)


def _groups(file: Path, asked: list[str] | None, found: Collection[str]) -> list[str]:
    """The groups of joints to export."""
    groups = asked or sorted(found)
    if missing := [name for name in groups if name not in found]:
        problem = f"{file} has no {', '.join(missing)}; it has {', '.join(sorted(found))}"
        raise UsageError(where="--group", problem=problem)
    return groups


def _export_bag(out: Output, file: Path, folder: Path, asked: list[str] | None, names: Names) -> None:
    require("mcap", "record")
    require("rosbags", "ros")
    from trade_gateway.recording import _ros2_bag  # noqa: PLC0415 - loads what the other commands do not need
    from trade_gateway.recording._motion import motions  # noqa: PLC0415 - likewise
    from trade_gateway.ros_messages._joint_names import JointNames  # noqa: PLC0415 - likewise

    found = motions(file)
    groups = _groups(file, asked, found)
    joints = sorted({joint for group in groups for measured in found[group][:1] for joint in measured.names})
    known = JointNames(joints, short=names is Names.LAST, named={})
    written = _ros2_bag.write(folder, file, groups, dict(zip(joints, known.ros_names, strict=True)).__getitem__)
    if not written:
        complain(f"{file} has neither joints nor pictures: the bag is empty")
    if out.as_json:
        out.data({"folder": str(folder), "topics": written})
    for topic, count in written.items():
        out.say(f"  {topic}: {count} messages")
    out.say(f"[bold]exported[/] {sum(written.values())} messages to {escape(str(folder))}")


def _export_dataset(
    out: Output, file: Path, folder: Path, asked: list[str] | None, fps: int, cut: EpisodeBoundary, task: str | None
) -> None:
    require("mcap", "export")
    require("pyarrow", "export")
    from trade_gateway.recording import _lerobot  # noqa: PLC0415 - loads what the other commands do not need
    from trade_gateway.recording._episodes import Span, episodes, locked  # noqa: PLC0415 - likewise
    from trade_gateway.recording._motion import motions  # noqa: PLC0415 - likewise
    from trade_gateway.recording._reader import entries  # noqa: PLC0415 - likewise

    found = motions(file)
    if not found:
        raise ConfigurationError(where=str(file), problem="has no joints")
    groups = _groups(file, asked, found)
    states = {name: found[name] for name in groups}
    joints = [joint for measured in states.values() for joint in measured[0].names]
    spans = locked(entries(file), joints) if cut is EpisodeBoundary.LOCKS else [Span(file.stem)]
    if task is not None:
        spans = [span._replace(task=task) for span in spans]
    made = list(episodes(states, spans, fps, lambda span, what: complain(f"{span.task} {what}")))
    if not made:
        why = "" if spans else ": no lock over these joints was recorded"
        raise ConfigurationError(where=str(file), problem=f"has no episode of {', '.join(groups)}{why}")
    _lerobot.write(folder, ", ".join(groups), joints, fps, made, file.name)
    frames = sum(len(episode.states) for episode in made)
    if out.as_json:
        tasks = [episode.task for episode in made]
        out.data({"folder": str(folder), "episodes": len(made), "frames": frames, "joints": joints, "tasks": tasks})
    for number, episode in enumerate(made):
        out.say(f"  episode {number}: {escape(episode.task)}, {len(episode.states) / fps:.1f} s")
    out.say(f"[bold]exported[/] {frames} frames of {len(joints)} joints to {escape(str(folder))}")
