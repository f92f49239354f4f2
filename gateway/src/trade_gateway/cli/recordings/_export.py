"""``trade export``: writes a recording as a dataset of episodes for machine learning."""

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output, complain
from trade_gateway.recording import require


class Cut(str, Enum):
    """How a recording is cut into episodes."""

    WHOLE = "whole"
    LOCKS = "locks"


def export(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="A recording.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="New or empty folder for the dataset.")],
    group: Annotated[
        list[str] | None, typer.Option(help="Export only these joints or this arm. Repeatable. Default: all.")
    ] = None,
    fps: Annotated[int, typer.Option(min=1, max=1000, metavar="HZ", help="Frame rate, in Hz.")] = 30,
    cut: Annotated[
        Cut, typer.Option("--episodes", help="whole: one episode; locks: one per lock of the joints.")
    ] = Cut.WHOLE,
    task: Annotated[
        str | None, typer.Option(help="Description of the task. Default: the lock's purpose, or the file's name.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Export the joints of a recording as a LeRobot dataset (v3.0).

    The dataset has Parquet tables, without pictures.
    observation.state is the measured position in rad; action is the position measured one frame later.

    For example: trade export walk.mcap walk/ --group rosie.legs --episodes locks --fps 30
    """
    require("mcap", "export")
    require("pyarrow", "export")
    from trade_gateway.recording import _lerobot  # noqa: PLC0415 - loads what the other commands do not need
    from trade_gateway.recording._episodes import Span, episodes, locked  # noqa: PLC0415 - likewise
    from trade_gateway.recording._motion import motions  # noqa: PLC0415 - likewise
    from trade_gateway.recording._reader import entries  # noqa: PLC0415 - likewise

    found = motions(file)
    if not found:
        raise ConfigurationError(where=str(file), problem="has no joints")
    groups = group or sorted(found)
    if missing := [name for name in groups if name not in found]:
        problem = f"{file} has no {', '.join(missing)}; it has {', '.join(sorted(found))}"
        raise UsageError(where="--group", problem=problem)
    states = {name: found[name] for name in groups}
    joints = [joint for measured in states.values() for joint in measured[0].names]
    spans = locked(entries(file), joints) if cut is Cut.LOCKS else [Span(file.stem)]
    if task is not None:
        spans = [span._replace(task=task) for span in spans]
    made = list(episodes(states, spans, fps, lambda span, what: complain(f"{span.task} {what}")))
    if not made:
        raise ConfigurationError(where=str(file), problem=f"has no episode of {', '.join(groups)}")
    _lerobot.write(folder, ", ".join(groups), joints, fps, made, file.name)
    out, frames = Output(as_json=as_json), sum(len(episode.states) for episode in made)
    if as_json:
        tasks = [episode.task for episode in made]
        out.data({"folder": str(folder), "episodes": len(made), "frames": frames, "joints": joints, "tasks": tasks})
    for number, episode in enumerate(made):
        out.say(f"  episode {number}: {escape(episode.task)}, {len(episode.states) / fps:.1f} s")
    out.say(f"[bold]exported[/] {frames} frames of {len(joints)} joints to {escape(str(folder))}")
