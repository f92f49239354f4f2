"""User and password of a system: the default pair of a user, and the file that passes a pair to the transport.

Both ends of every link hold the same pair. The end that is dialled checks it, so a container without the pair, or with
another one, is not linked in either direction.
"""

import contextlib
import os
import secrets
import stat
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Final

from trade._paths import runtime_folder, runtime_folders
from trade.errors import ConfigurationError

_FILE: Final = "@secret"
"""No system can have this name: the folders of systems are beside this file."""
_USER: Final = "host"
_OPEN_FILES: Final = Path("/proc/self/fd")


def user_secret() -> tuple[str, str]:
    """The default pair of all containers of this user on this host; the first container creates it.

    Raises:
        ConfigurationError: other users can read the file or could have planted it.
    """
    places = [folder / _FILE for folder in runtime_folders()]
    path = next((one for one in places if one.exists()), None)
    if path is None:
        path = places[0]
        _create(path, secrets.token_urlsafe(32))
    _check_private(path)
    secret = path.read_text(encoding="ascii").strip()
    keep_secret(secret)
    return _USER, secret


def keep_secret(secret: str) -> None:
    """Writes the default pair's secret to each folder that has none: one of them may be emptied at any time."""
    for folder in runtime_folders():
        if not (folder / _FILE).exists():
            with contextlib.suppress(OSError):
                _create(folder / _FILE, secret)


def _create(path: Path, secret: str) -> None:
    with _private_file(secret, path.parent) as fresh, contextlib.suppress(FileExistsError):
        os.link(fresh, path)  # the second container takes the first one's


@contextlib.contextmanager
def dictionary_file(credentials: tuple[str, str]) -> Generator[Path]:
    """Yields the credentials that a session accepts, as the file that zenoh reads while the session opens.

    The file is in memory where the platform supports that, so that a full disk keeps no container out.
    """
    text = ":".join(credentials) + "\n"
    if not (hasattr(os, "memfd_create") and _OPEN_FILES.is_dir()):
        with _private_file(text, runtime_folder()) as path:
            yield path
        return
    with os.fdopen(os.memfd_create("trade-credentials"), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield _OPEN_FILES / str(file.fileno())


@contextlib.contextmanager
def _private_file(text: str, folder: Path) -> Generator[Path]:
    descriptor, name = tempfile.mkstemp(prefix="@", dir=folder)  # for this user only
    path = Path(name)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        yield path
    finally:
        path.unlink(missing_ok=True)


def _check_private(path: Path) -> None:
    state = path.lstat()
    private = not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not stat.S_IMODE(state.st_mode) & 0o077)
    if not private or not stat.S_ISREG(state.st_mode) or not state.st_size:
        raise ConfigurationError(
            where=str(path), problem="must belong to this user alone; remove it, a new one is made"
        )
