"""How the containers of one system find each other on one host: a folder with a file for each one's loopback endpoint.

The loopback interface carries no multicast. Who starts writes its own endpoint first and reads the others' then, so of
two that start together at least one sees the other; the newcomer dials everybody.
"""

import contextlib
import logging
import os
import time
from pathlib import Path
from typing import Final

from trade._paths import runtime_folder
from trade._transport.endpoints import accepts, free_endpoint

__all__ = ["HostFolder", "free_endpoint"]

_logger = logging.getLogger("trade")

_YOUNG_S: Final = 10.0
"""A file this young may belong to a container that does not listen yet, if its process lives."""


class HostFolder:
    """One system's folder on this host; only this user can read or write it."""

    def __init__(self, system: str) -> None:
        self._folder = runtime_folder() / system
        self._folder.mkdir(mode=0o700, exist_ok=True)
        self._own: Path | None = None

    def enter(self, endpoint: str) -> list[str]:
        """Say where we listen; returns where the others do.

        Who cannot say it, as on a full disk, dials the others all the same: it may be there to stop them.
        """
        name = endpoint.replace("/", "_").replace(":", "_")
        own, fresh = self._folder / name, self._folder / f".{name}.{os.getpid()}"
        try:
            fresh.write_text(f"{endpoint}\n{os.getpid()}\n{time.monotonic()}\n", encoding="ascii")
            self._own = fresh.replace(own)
        except OSError as bad:
            with contextlib.suppress(OSError):
                fresh.unlink()
            _logger.warning("%s cannot be written: %s; who starts later on this host may not find this one", own, bad)
        return self._others()

    def _others(self) -> list[str]:
        found: list[str] = []
        for path in sorted(path for path in self._folder.iterdir() if not path.name.startswith(".")):
            with contextlib.suppress(OSError, ValueError):
                if path == self._own:
                    continue
                endpoint, writer, entered, *_ = [*path.read_text(encoding="ascii").strip().split("\n"), "", ""]
                if accepts(endpoint) or (_is_young(path, entered) and _may_live(writer)):
                    found.append(endpoint)
                else:
                    path.unlink()
        return found

    def leave(self) -> None:
        """Take our endpoint away. Idempotent."""
        if self._own is not None:
            self._own.unlink(missing_ok=True)
            self._own = None


def _is_young(path: Path, entered: str) -> bool:
    """Whether it was written a moment ago, by a clock that nobody sets; on some systems that is set as they start."""
    try:
        return abs(time.monotonic() - float(entered)) < _YOUNG_S  # of before the last start of the host: any number
    except ValueError:  # it was written by something else
        return time.time() - path.stat().st_mtime < _YOUNG_S


def _may_live(writer: str) -> bool:
    """Whether the process that wrote a file may be about to listen; not known on every operating system."""
    if os.name != "posix" or not writer.isdigit():  # elsewhere signal 0 is no question
        return True
    try:
        os.kill(int(writer), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
