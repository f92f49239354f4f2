"""A command of ours that goes on without the terminal, or the connection, that it was given in."""

import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from trade import Settings
from trade.errors import ConfigurationError

_UP_S: Final = 30.0


def detached(words: Sequence[str], settings: Settings) -> dict[str, Any]:
    """Run ``trade WORDS --json`` on its own; returns what it says when it is up.

    What it complains of goes to a file ``logs/CONTAINER.log`` in the folder for state.

    Raises:
        ConfigurationError: it ended, or was not up in time; with what it complained of.
    """
    folder = (settings.state_dir or Path(tempfile.gettempdir())) / settings.system / "logs"
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"{settings.container}.log"
    with log.open("w") as errors:
        process = subprocess.Popen(  # noqa: S603 - this very program
            [sys.executable, "-m", "trade_gateway", *words, "--json"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
        )
    assert process.stdout is not None  # noqa: S101 - it is a pipe
    line = _first_line(process.stdout)
    process.stdout.close()
    try:
        return msgspec.json.decode(line, type=dict[str, Any])
    except msgspec.DecodeError:
        process.kill()
        process.wait()
        said = log.read_text().strip()[-500:] or f"nothing; it was not up within {_UP_S:g} s"
        raise ConfigurationError(where="--detach", problem=f"it did not come up and said: {said}") from None


def _first_line(pipe: IO[str]) -> str:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=lambda: lines.put(pipe.readline()), name="trade-detached", daemon=True).start()
    try:
        return lines.get(timeout=_UP_S)
    except queue.Empty:
        return ""
