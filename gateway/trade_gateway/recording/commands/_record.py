"""``trade record``: records a system to an MCAP file, or keeps the last seconds to save them at a fault."""

from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Final

import typer

from trade_gateway._usage import UsageError
from trade_gateway.process._signals import leaving, refuse_twice
from trade_gateway.recording import require
from trade_gateway.recording._sources import RecordedParts
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import TIMING, Groups, Json, Readers
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor

SECTION: Final = sections.RECORDINGS
PLACE: Final = 0
MB: Final = 1_000_000
_RATES: Final = "Rates"
_RING: Final = "Last seconds before a fault"


def record(
    context: typer.Context,
    file: Annotated[
        Path | None,
        typer.Argument(metavar="OUT.mcap", help="The file to write; in a folder, a file named by the time."),
    ] = None,
    group: Groups = None,
    services: Readers = None,
    hz: Annotated[
        float,
        typer.Option(
            rich_help_panel=_RATES, min=0.001, max=1000.0, metavar="HZ", help="Highest rate of joint samples, in Hz."
        ),
    ] = 50.0,
    camera_hz: Annotated[
        float,
        typer.Option(
            rich_help_panel=_RATES, min=0.001, max=1000.0, metavar="HZ", help="Highest rate of pictures, in Hz."
        ),
    ] = 5.0,
    service_hz: Annotated[
        float,
        typer.Option(
            rich_help_panel=_RATES, min=0.001, max=1000.0, metavar="HZ", help="Rate of --services samples, in Hz."
        ),
    ] = 10.0,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.1, rich_help_panel=TIMING, metavar="SECONDS", help="Duration, in seconds; by default until Ctrl-C."
        ),
    ] = None,
    attach: Annotated[
        list[Path] | None, typer.Option(help="File to embed in the recording: rosie.toml. Repeatable.")
    ] = None,
    keep_last: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=_RING, min=1.0, max=3600.0, metavar="SECONDS", help="Time to keep in memory, in seconds."
        ),
    ] = None,
    at_fault: Annotated[
        Path | None, typer.Option(rich_help_panel=_RING, metavar="FOLDER", help="Folder for a file at each fault.")
    ] = None,
    most_mb: Annotated[int, typer.Option(rich_help_panel=_RING, min=1, help="Most memory, in MB.")] = 256,
    name: Annotated[str | None, typer.Option(help="Name of the container. \\[env: TRADE_CONTAINER]")] = None,
    as_json: Json = False,
) -> None:
    """Record joints, cameras, calls, locks and faults to an MCAP file.

    The file grows every second and stays readable if the recorder is killed. It has no arguments and results of calls.
    With --keep-last and --at-fault, only the last seconds before each fault are saved.

    For example: trade record walk.mcap --group rosie --attach rosie.toml
    """
    if (file is None) == (at_fault is None) or (at_fault is None) != (keep_last is None):
        problem = "needs a destination: OUT.mcap, or --keep-last 30 --at-fault FOLDER"
        raise UsageError(where="trade record", problem=problem)
    wanted = RecordedParts(group or [], services or [], hz, camera_hz, service_hz)
    attachments = [_read(path) for path in attach or []]
    require("mcap", "record")
    from trade_gateway.recording.commands import _progress as room  # noqa: PLC0415 - loads what the other commands do not need

    out = Output(as_json=as_json)
    with (
        leaving() as ending,
        visitor(context, name, on_terminate=ending.set) as container,
        room.Recorder(container, wanted, ending) as recorder,
    ):
        if name is not None:
            refuse_twice(container, "trade record")
        if file is not None:
            path = _fresh(file, container.name)
            room.to_file(path, out, recorder, room.about(container, wanted), attachments, seconds)
        elif at_fault is not None and keep_last is not None:
            ring = room.Ring(keep_last, most_mb * MB)
            room.kept_for_faults(at_fault, ring, out, recorder, room.about(container, wanted), attachments, seconds)


def _fresh(file: Path, name: str) -> Path:
    """Returns the file to write: in a folder, one that no earlier start of the recorder has written."""
    return file / f"{name}-{datetime.now(timezone.utc):%Y%m%dT%H%M%S.%fZ}.mcap" if file.is_dir() else file


def _read(path: Path) -> tuple[str, bytes]:
    try:
        return path.name, path.read_bytes()
    except OSError as bad:
        raise UsageError(where=f"--attach {path}", problem=f"cannot be read: {bad.strerror}") from None
