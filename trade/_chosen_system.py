"""The system that ``trade use`` has chosen for this user: settings for programs whose environment names no system."""

import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade.toml_files import read_toml_text

CHOSEN: Final = ("TRADE_SYSTEM", "TRADE_CONNECT", "TRADE_TLS", "TRADE_POLICY")
"""The settings that can be chosen, by their variables; the first one always is."""
_REMEDY: Final = "write it again with `trade use SYSTEM`, or end the choice with `trade use --clear`"


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
