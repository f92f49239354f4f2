"""The folder in which containers of one user on one host keep shared files: one rule, whatever the environment says."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from trade.errors import ConfigurationError

_HAS_USERS: Final = hasattr(os, "getuid")
_OF_LOGINS: Final = Path("/run/user")
"""A session manager makes a folder for each user there at its first login, and removes it at the last logout."""
_ALWAYS: Final = Path("/tmp")  # noqa: S108 - a folder of our own in it is checked
_NOT_OWN: Final = "others may write there; remove it, or set TRADE_RUNTIME_DIR to a folder of your own"


def runtime_folder() -> Path:
    """The folder where files are made. Raises OSError, ConfigurationError: others may write there."""
    return runtime_folders()[0]


def runtime_folders() -> list[Path]:
    """The folder where files are made, and then all others where containers of this user may have made theirs.

    Raises:
        OSError: no folder can be made.
        ConfigurationError: others may write there.
    """
    named = os.environ.get("TRADE_RUNTIME_DIR")
    if named:
        return [_made(Path(named) / "trade")]
    found: list[Path] = []
    problem: OSError | ConfigurationError | None = None
    for folder in _rule():
        try:
            found.append(_made(folder))
        except (OSError, ConfigurationError) as bad:
            problem = problem or bad
    if problem is not None and not found:
        raise problem
    for folder in _earlier():
        with contextlib.suppress(OSError, ConfigurationError):
            if folder.is_dir() and folder not in found:
                found.append(_made(folder))
    return found


def _rule() -> Sequence[Path]:
    """Where files are made: the first folder that this user can use. The environment does not count."""
    if not _HAS_USERS:
        return [Path(tempfile.gettempdir()) / "trade-user"]
    uid, login = os.getuid(), _OF_LOGINS / str(os.getuid())
    with contextlib.suppress(OSError):
        if login.stat().st_uid == uid:
            return [login / "trade", _ALWAYS / f"trade-{uid}"]
    return [_ALWAYS / f"trade-{uid}"]


def _earlier() -> Sequence[Path]:
    """Where an earlier release made them, by the environment."""
    base, uid = os.environ.get("XDG_RUNTIME_DIR"), os.getuid() if _HAS_USERS else "user"
    return [*([Path(base) / "trade"] if base else []), Path(tempfile.gettempdir()) / f"trade-{uid}"]


def _made(folder: Path) -> Path:
    """The folder, made if it is missing. Raises OSError, ConfigurationError."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if _HAS_USERS:
        state = folder.lstat()  # a link may lead to any folder
        if state.st_uid != os.getuid() or stat.S_IMODE(state.st_mode) & 0o022:
            raise ConfigurationError(where=str(folder), problem=_NOT_OWN)
    return folder
