"""The system of programs that name none: what ``trade use`` has chosen for the user, else the user's default one."""

import contextlib
import getpass
import hashlib
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from trade.errors import ConfigurationError
from trade.protocol.keys import as_chunk
from trade.text_files import read_text
from trade.toml_files import read_toml_text

CHOSEN: Final = ("TRADE_SYSTEM", "TRADE_CONNECT", "TRADE_TLS", "TRADE_POLICY")
"""The settings that can be chosen, by their variables; the first one always is."""
_REMEDY: Final = "write it again with `trade use SYSTEM`, or end the choice with `trade use --clear`"
_MACHINE_IDS: Final = (Path("/etc/machine-id"), Path("/var/lib/dbus/machine-id"))
_MACHINE_ID: Final = re.compile(r"[0-9a-f]{32}")
_NO_MACHINE: Final = "local"
_HAS_USERS: Final = hasattr(os, "getuid")


def default_system() -> str:
    """The default system of this user on this host, such as ``user1000-3f9a61c2``: of the user id and the machine id.

    A host without a valid machine id, such as a container image, has ``user1000-local``.
    """
    machine = _machine_id()
    # the machine id is confidential (man 5 machine-id), so a name has a hash of it
    host = hashlib.sha256(f"trade default system {machine}".encode()).hexdigest()[:8] if machine else _NO_MACHINE
    return f"{_of_user()}{host}"


def is_of_user(system: str) -> bool:
    """Whether a name is, or was, a default system of this user: also of another machine id, or an old USER@HOST."""
    return system.startswith(_of_user()) or "@" in system


def earlier_folders(base: Path, system: str) -> Iterator[Path]:
    """The folders in a base folder that belong to default systems of this user, without that of the system itself."""
    with contextlib.suppress(OSError):
        yield from (one for one in sorted(base.iterdir()) if one.name != system and is_of_user(one.name))


def take_over(folder: Path, database: str) -> None:
    """Copies a database (SQLite) to a default system's folder from its newest earlier name, unless it has its own.

    Args:
        folder: of the system; that of an explicit system takes nothing over.
        database: the name of its file in that folder, such as ``angles/rosie.sqlite``.
    """
    wanted = folder / database
    if wanted.exists() or not folder.name.startswith(_of_user()):
        return
    found = [one / database for one in earlier_folders(folder.parent, folder.name) if (one / database).exists()]
    if not found:
        return
    newest = max(found, key=lambda one: max(part.stat().st_mtime_ns for part in _parts(one)))
    wanted.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    for part in reversed(_parts(newest)):  # the database itself comes last: without it, it is taken over again
        shutil.copy2(part, wanted.with_name(part.name))


def _parts(database: Path) -> list[Path]:
    log = database.with_name(f"{database.name}-wal")
    return [database, log] if log.exists() else [database]


def account_name() -> str:
    """The name of this user's account; variables such as ``USER`` count only where the host has no accounts."""
    try:
        if not _HAS_USERS:
            return as_chunk(getpass.getuser())
        import pwd  # noqa: PLC0415 - some operating systems lack it

        return as_chunk(pwd.getpwuid(os.getuid()).pw_name)
    except (ImportError, OSError, KeyError):  # a container image without a user name
        return "nobody"


def account_home() -> Path | None:
    """The home directory of this user's account, whatever ``HOME`` says; None if the host knows none."""
    try:
        import pwd  # noqa: PLC0415 - some operating systems lack it

        home = Path(pwd.getpwuid(os.getuid()).pw_dir)
    except (ImportError, KeyError):
        return None
    return home if home.is_dir() else None


def _of_user() -> str:
    return f"user{os.getuid()}-" if _HAS_USERS else f"user-{account_name()}-"


def _machine_id() -> str:
    """The machine id; empty if there is none yet, as early in the first boot, or in a container image."""
    for file in _MACHINE_IDS:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            text = file.read_text(encoding="ascii").strip().lower()
            if _MACHINE_ID.fullmatch(text) and text.strip("0"):
                return text
    return ""


def chosen_file(environment: Mapping[str, str]) -> Path | None:
    """The file of the choice, which need not exist; None without a home directory."""
    base = environment.get("XDG_CONFIG_HOME")
    try:
        return (Path(base) if base else Path.home() / ".config") / "trade" / "use.toml"
    except RuntimeError:  # no home directory
        return None


def chosen_settings(environment: Mapping[str, str]) -> dict[str, str]:
    """The settings of the choice, by their variables; empty without a choice.

    Raises:
        ConfigurationError: others may write the file, or its content is wrong.
    """
    file = chosen_file(environment)
    try:
        state = None if file is None else file.stat()
        if file is None or state is None:
            return {}
        if hasattr(os, "getuid") and (state.st_uid != os.getuid() or stat.S_IMODE(state.st_mode) & 0o022):
            raise ConfigurationError(where=str(file), problem=f"others may write this file; {_REMEDY}")
        found = read_toml_text(read_text(file))
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return {}
    except (OSError, ValueError) as bad:
        raise ConfigurationError(where=str(file), problem=f"cannot be read: {bad}; {_REMEDY}") from None
    wrong = [key for key, value in found.items() if key not in CHOSEN or not isinstance(value, str)]
    if wrong or not found.get(CHOSEN[0]):
        problem = f"has a wrong {wrong[0]}" if wrong else f"has no {CHOSEN[0]}"
        raise ConfigurationError(where=str(file), problem=f"{problem}; {_REMEDY}")
    return found
