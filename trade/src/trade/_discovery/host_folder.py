"""Discovery on one host: a folder with a file for the loopback endpoint of each container of a system.

The loopback interface carries no multicast. A container that starts writes its own endpoint first and then reads the
others', so of two that start together at least one sees the other; the newcomer dials all others.
"""

import contextlib
import logging
import os
import time
from pathlib import Path
from typing import Final

from trade._atomic_file import replace
from trade._paths import runtime_folder
from trade._transport.endpoints import accepts, free_endpoint

__all__ = ["HostFolder", "free_endpoint"]

_logger = logging.getLogger("trade")

_YOUNG_S: Final = 10.0
"""A file younger than this may belong to a container that does not listen yet, if its process is alive."""


class HostFolder:
    """One system's folder on this host; only this user can read or write it."""

    def __init__(self, system: str) -> None:
        self._folder = runtime_folder() / system
        self._folder.mkdir(mode=0o700, exist_ok=True)
        self._own: Path | None = None

    def enter(self, endpoint: str) -> list[str]:
        """Publish our endpoint; returns the endpoints of the others.

        A container that cannot write, as on a full disk, still dials the others: it may be there to stop them.
        """
        name = endpoint.replace("/", "_").replace(":", "_")
        own = self._folder / name
        try:
            replace(own, f"{endpoint}\n{os.getpid()}\n{time.monotonic()}\n".encode("ascii"))
            self._own = own
        except OSError as bad:
            _logger.warning("%s cannot be written: %s. Later containers on this host may not find this one", own, bad)
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
        """Remove our endpoint. Idempotent."""
        if self._own is not None:
            self._own.unlink(missing_ok=True)
            self._own = None


def _is_young(path: Path, entered: str) -> bool:
    """Whether a file was written a moment ago, by a monotonic clock; some systems set that clock at boot."""
    try:
        return abs(time.monotonic() - float(entered)) < _YOUNG_S  # from before the last boot: any number
    except ValueError:  # another program wrote it
        return time.time() - path.stat().st_mtime < _YOUNG_S


def _may_live(writer: str) -> bool:
    """Whether the process that wrote a file may be about to listen; not known on every operating system."""
    if os.name != "posix" or not writer.isdigit():  # elsewhere signal 0 is not a check
        return True
    try:
        os.kill(int(writer), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
