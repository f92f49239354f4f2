"""``trade record``: write what happens in a system to an MCAP file, or keep the last seconds for when it goes wrong."""

from pathlib import Path
from typing import Annotated, Final

import typer

from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Groups, Json, Readers
from trade_gateway.cli._output import Output
from trade_gateway.cli._system_choice import visitor
from trade_gateway.process._signals import leaving
from trade_gateway.recording import require
from trade_gateway.recording._sources import Wanted

MB: Final = 1_000_000


def record(
    context: typer.Context,
    file: Annotated[Path | None, typer.Argument(metavar="OUT.mcap", help="The file to make.")] = None,
    group: Groups = None,
    services: Readers = None,
    hz: Annotated[float, typer.Option(min=0.001, max=1000.0, help="Samples of joints a second, at most.")] = 50.0,
    camera_hz: Annotated[float, typer.Option(min=0.001, max=1000.0, help="Pictures a second, at most.")] = 5.0,
    service_hz: Annotated[float, typer.Option(min=0.001, max=1000.0, help="Samples of --services a second.")] = 10.0,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so long; else with Ctrl-C.")] = None,
    attach: Annotated[
        list[Path] | None, typer.Option(help="A file to put into the recording: the robot file. Repeatable.")
    ] = None,
    keep_last: Annotated[
        float | None, typer.Option(min=1.0, max=3600.0, help="Keep so many seconds in memory instead (--at-fault).")
    ] = None,
    at_fault: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Where to save them when something goes wrong.")
    ] = None,
    most_mb: Annotated[int, typer.Option(min=1, help="With --keep-last: megabytes of memory at most.")] = 256,
    as_json: Json = False,
) -> None:
    """Record joints, cameras, calls, locks and faults; any MCAP reader opens the file.

    It grows every second, and is readable so far if this is killed. Calls are noted without arguments and results.

    For example: trade record walk.mcap --group rosie --attach rosie.toml
    """
    if (file is None) == (at_fault is None) or (at_fault is None) != (keep_last is None):
        problem = "say where to: OUT.mcap, or --keep-last 30 --at-fault FOLDER"
        raise UsageError(where="trade record", problem=problem)
    wanted = Wanted(group or [], services or [], hz, camera_hz, service_hz)
    attachments = [_read(path) for path in attach or []]
    require("mcap", "record")
    from trade_gateway.cli.recordings import _progress as room  # noqa: PLC0415 - loads what the other commands do not need

    out = Output(as_json=as_json)
    with leaving() as ending, visitor(context) as container, room.Recorder(container, wanted, ending) as recorder:
        if file is not None:
            room.to_file(file, out, recorder, room.about(container, wanted), attachments, seconds)
        elif at_fault is not None and keep_last is not None:
            ring = room.Ring(keep_last, most_mb * MB)
            room.kept_for_faults(at_fault, ring, out, recorder, room.about(container, wanted), attachments, seconds)


def _read(path: Path) -> tuple[str, bytes]:
    try:
        return path.name, path.read_bytes()
    except OSError as bad:
        raise UsageError(where=f"--attach {path}", problem=f"cannot be read: {bad.strerror}") from None
