"""Runs a command as a detached process, which outlives its terminal or connection."""

import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer
from rich.markup import escape

from trade import Container, Settings
from trade.command_output import as_text
from trade.errors import CannotStart
from trade.starting import Started
from trade_gateway.terminal._output import Output

_UP_S: Final = 45.0
"""The longest start in seconds; less than a start through ssh may take."""
_END_S: Final = 10.0
_LOOK_EVERY_S: Final = 0.05

Detach = Annotated[bool, typer.Option("--detach", help="Return when it is up, and keep it running in the background.")]


def detach_now(out: Output, settings: Settings) -> None:
    """Runs this command again as a detached process, and reports when it is up. Raises CannotStart."""
    words = [word for word in sys.argv[1:] if word not in {"--detach", "--json"}]
    started = detached(words, settings)
    if out.as_json:
        out.data(started)
    out.say(f"[bold green]{escape(started.container)} is up[/], process {started.pid}")


def detached(words: Sequence[str], settings: Settings, environment: Mapping[str, str] | None = None) -> Started:
    """Runs ``trade WORDS --json`` as a detached process; returns its first line, printed when it is up.

    Standard error goes to ``logs/CONTAINER.log`` in the folder for state, standard output to ``CONTAINER.jsonl``.

    Args:
        words: a command whose first line reports that its container is up.
        settings: the container's name, system and folder for state.
        environment: the process's environment; by default this one's.

    Raises:
        CannotStart: the process ended, or was not up in time; with its standard error.
    """
    name, folder = settings.container, (settings.state_dir or Path(tempfile.gettempdir())) / settings.system / "logs"
    folder.mkdir(parents=True, exist_ok=True)
    reported, log = folder / f"{name}.jsonl", folder / f"{name}.log"
    with reported.open("w") as output, log.open("w") as errors:
        process = subprocess.Popen(  # noqa: S603 - this very program
            [sys.executable, "-m", "trade_gateway", *words, "--json"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=errors,
            env=environment,
            start_new_session=True,
        )
    try:
        return msgspec.json.decode(_first_line(reported, process), type=Started)
    except msgspec.DecodeError:
        _end(process)
        complaint = (
            as_text(log.read_text(errors="replace")).strip()[-500:] or f"nothing; it was not up within {_UP_S:g} s"
        )
        here, why = socket.gethostname(), "it did not come up"
        raise CannotStart(host=here, container=name, reason=why, output=complaint, remedy=f"its log is {log}") from None
    except BaseException:  # an interrupted start is ended, too
        _end(process)
        raise


def ready(container: Container) -> dict[str, object]:
    """Returns the first line of JSON of a command whose container is up."""
    address = container.address
    up = {"ready": True, "container": address.container, "epoch": address.epoch, "pid": os.getpid()}
    return {**up, "system": container.settings.system}


def _first_line(reported: Path, process: "subprocess.Popen[bytes]") -> bytes:
    until, pause = time.monotonic() + _UP_S, threading.Event()
    while process.poll() is None and time.monotonic() < until:
        line, ended, _ = reported.read_bytes().partition(b"\n")
        if ended:
            return line
        pause.wait(_LOOK_EVERY_S)
    return b""


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
