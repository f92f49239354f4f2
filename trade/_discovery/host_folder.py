"""Discovery on one host: a folder with a file for the loopback endpoint of each container of a system.

The loopback interface carries no multicast. Containers enter one after the other: each writes its own endpoint, reads
those of the earlier ones, and dials them. No two dial each other.
"""

import contextlib
import errno
import logging
import os
import socket
import time
from collections.abc import Generator
from io import FileIO
from pathlib import Path
from typing import Final

from trade._paths import runtime_folder, runtime_folders
from trade.atomic_files import fresh_beside
from trade.errors import ConfigurationError
from trade.transport.endpoints import Endpoint

try:
    import fcntl
except ImportError:  # only some operating systems have it
    fcntl = None

_logger = logging.getLogger("trade")

_YOUNG_S: Final = 10.0
"""A file younger than this may belong to a container that does not listen yet, if its process is alive."""
_LOCKED: Final = "locked"
"""The last line of a file that its process keeps locked (``flock``): without the lock, the process is gone."""
_CONNECT_S: Final = 0.5
_TURN_S: Final = 1.0
"""A container that enters takes milliseconds. Without a turn by then, as if one is frozen, the next enters as well."""
_LOOK_S: Final = 0.001


class HostFolder:
    """One system's folder on this host; only this user can read or write it."""

    def __init__(self, system: str) -> None:
        self._system = system
        self._folder()
        self._endpoint = ""
        self._own: Path | None = None
        self._file: FileIO | None = None
        """The file, open and locked for as long as this process lives."""
        self.entered_ns = 0
        """When this container entered, by the monotonic clock: after all others whose endpoints it read."""
        self._warned = False

    def _folder(self) -> Path:
        folder = runtime_folder() / self._system
        folder.mkdir(mode=0o700, exist_ok=True)
        return folder

    def enter(self, endpoint: str) -> list[str]:
        """Publish our endpoint; returns the endpoints of the others.

        A container that cannot write, as on a full disk, still dials the others: it may be there to stop them.
        """
        self._endpoint = endpoint
        with self._turn():
            self.entered_ns = time.monotonic_ns()
            self._publish()
            return self._others()

    @contextlib.contextmanager
    def _turn(self) -> Generator[None, None, None]:
        """Enter while no other container does; without a file system with locks, at once."""
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError, ConfigurationError):
                folder = os.open(self._folder(), os.O_RDONLY)
                stack.callback(os.close, folder)
                _wait_locked(folder)
            yield

    def keep(self) -> None:
        """Publish our endpoint again if its file has vanished, as when the folder was emptied. Called now and then."""
        if not self._endpoint:
            return
        with contextlib.suppress(OSError):
            file = None if self._file is None else os.fstat(self._file.fileno())
            if self._own is not None and file is not None and os.path.samestat(self._own.stat(), file):
                return
        if self._own is not None:
            _logger.warning("%s has vanished, and is written again", self._own)
        self._publish()

    def _publish(self) -> None:
        before, self._file = self._file, None
        try:
            own = self._folder() / self._endpoint.replace("/", "_").replace(":", "_")
            self._file, self._own = _written(own, f"{self._endpoint}\n{os.getpid()}\n{time.monotonic()}\n"), own
        except (OSError, ConfigurationError) as bad:
            if not self._warned:
                _logger.warning(
                    "the endpoint %s cannot be written: %s. Later containers on this host may not find this one",
                    self._endpoint,
                    bad,
                )
            self._own = None
        self._warned = self._own is None
        if before is not None:
            before.close()

    def _others(self) -> list[str]:
        found: list[str] = []
        for path in self._files():
            with contextlib.suppress(OSError, ValueError):
                if path == self._own:
                    continue
                text = path.read_text(encoding="ascii").strip().split("\n")
                endpoint, writer, entered, locked, *_ = [*text, "", "", ""]
                if _is_gone(path, endpoint, writer, entered, locked):
                    path.unlink()
                else:
                    found.append(endpoint)
        return found

    def _files(self) -> list[Path]:
        found: list[Path] = []
        for folder in runtime_folders():
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                found += sorted(path for path in (folder / self._system).iterdir() if not path.name.startswith("."))
        return found

    def leave(self) -> None:
        """Remove our endpoint. Idempotent."""
        self._endpoint = ""
        if self._own is not None:
            self._own.unlink(missing_ok=True)
            self._own = None
        if self._file is not None:
            self._file.close()
            self._file = None


def _wait_locked(file: int) -> None:
    """Lock an open file, unless another process keeps it locked for a second. Raises OSError."""
    until = time.monotonic() + _TURN_S
    while fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                raise
            time.sleep(_LOOK_S)
        else:
            return


def _written(path: Path, text: str) -> FileIO:
    """The file, written at once, open and locked. Raises OSError."""
    fresh = fresh_beside(path)
    file = FileIO(os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o600), "r+")
    try:
        locked = False
        with contextlib.suppress(OSError):  # a file system without locks
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                locked = True
        data = f"{text}{_LOCKED if locked else ''}\n".encode("ascii")
        if file.write(data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        fresh.replace(path)
    except BaseException:
        file.close()
        fresh.unlink(missing_ok=True)
        raise
    return file


def _is_gone(path: Path, endpoint: str, writer: str, entered: str, locked: str) -> bool:
    """Whether the process of a file has ended. One that does not answer, as in a flood of connections, has not."""
    if fcntl is not None and locked == _LOCKED:
        with path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            return True
    return _refuses(endpoint) and not (_is_young(path, entered) and _may_live(writer))


def _refuses(endpoint: str) -> bool:
    """Whether no process listens at an endpoint; True for a text that is not valid."""
    try:
        where = Endpoint.read(endpoint)
        socket.create_connection((where.host.strip("[]"), where.port), timeout=_CONNECT_S).close()
    except OSError as bad:
        return isinstance(bad, ConnectionRefusedError | socket.gaierror)
    except (ValueError, OverflowError):  # ConfigurationError is a ValueError
        return True
    return False


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
