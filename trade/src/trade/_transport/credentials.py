"""User and password of a system: where those come from that nobody chose, and how the transport is given them.

Both ends of every link hold the same pair. The end that is dialled checks, so a container without it, or with another
one, is not linked in either direction.
"""

import contextlib
import os
import secrets
import stat
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Final

from trade._paths import runtime_folder
from trade.errors import ConfigurationError

__all__ = ["dictionary_file", "user_secret"]

_FILE: Final = "@secret"
"""No system can have this name: those have folders beside it."""
_USER: Final = "host"
_OPEN_FILES: Final = Path("/proc/self/fd")


def user_secret() -> tuple[str, str]:
    """The pair of all containers of this user on this host that were given none; made by the first of them.

    Raises:
        ConfigurationError: others could read or have planted it.
    """
    path = runtime_folder() / _FILE
    if not path.exists():
        with _private_file(secrets.token_urlsafe(32)) as fresh, contextlib.suppress(FileExistsError):
            os.link(fresh, path)  # who comes second takes the first one's
    _check_private(path)
    return _USER, path.read_text(encoding="ascii").strip()


@contextlib.contextmanager
def dictionary_file(credentials: tuple[str, str]) -> Generator[Path]:
    """Whom a session lets in, in the one form the transport takes it: a file, there while the session opens.

    It is in memory where there are such files, so that nobody is kept out by a full disk.
    """
    text = ":".join(credentials) + "\n"
    if not (hasattr(os, "memfd_create") and _OPEN_FILES.is_dir()):
        with _private_file(text) as path:
            yield path
        return
    with os.fdopen(os.memfd_create("trade-credentials"), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield _OPEN_FILES / str(file.fileno())


@contextlib.contextmanager
def _private_file(text: str) -> Generator[Path]:
    descriptor, name = tempfile.mkstemp(prefix="@", dir=runtime_folder())  # for this user only
    path = Path(name)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        yield path
    finally:
        path.unlink(missing_ok=True)


def _check_private(path: Path) -> None:
    state = path.lstat()
    ours = not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not stat.S_IMODE(state.st_mode) & 0o077)
    if not ours or not stat.S_ISREG(state.st_mode) or not state.st_size:
        raise ConfigurationError(where=str(path), problem="must be this user's alone; remove it, a new one is made")
