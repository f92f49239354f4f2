"""The folder in which containers of one user on one host keep shared files."""

import os
import stat
import tempfile
from pathlib import Path

from trade.errors import ConfigurationError


def runtime_folder() -> Path:
    named = os.environ.get("TRADE_RUNTIME_DIR")
    base = named or os.environ.get("XDG_RUNTIME_DIR")
    uid = str(os.getuid()) if hasattr(os, "getuid") else "user"
    folder = Path(base) / "trade" if base else Path(tempfile.gettempdir()) / f"trade-{uid}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if hasattr(os, "getuid"):
        state = folder.lstat()  # a link may lead to any folder
        if state.st_uid != os.getuid() or stat.S_IMODE(state.st_mode) & 0o022:
            problem = "others may write there; remove it, or set TRADE_RUNTIME_DIR to a folder of your own"
            raise ConfigurationError(where=str(folder), problem=problem)
    return folder
