"""What somebody knew when they asked last: so that there is something new."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from trade._protocol.messages import UNREADABLE
from trade_gateway.process._atomic_file import replace

__all__ = ["Memory"]

_MOST_BYTES: Final = 16 << 20


class Memory:
    """Which services there were, and where; kept in a file, or for as long as this lives.

    Args:
        path: the file, which need not be there; None: nothing is kept.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._known: Mapping[str, str] | None = None if path is None else _read(path)

    def news(self, services: Mapping[str, str]) -> tuple[list[str], list[str]] | None:
        """Who has come and who has gone since this was asked last; None: it never was.

        Args:
            services: the services that there are, and the container of each.
        """
        before, self._known = self._known, dict(services)
        if self._path is not None:
            with contextlib.suppress(OSError):  # what cannot be noted is told again
                self._path.parent.mkdir(parents=True, exist_ok=True)
                replace(self._path, msgspec.json.encode(self._known), 0o600)
        if before is None:
            return None
        came = sorted(label for label, container in services.items() if before.get(label) != container)
        return came, sorted(label for label in before if label not in services)


def _read(path: Path) -> dict[str, str] | None:
    try:
        with path.open("rb") as file:
            return msgspec.json.decode(file.read(_MOST_BYTES), type=dict[str, str])
    except (OSError, *UNREADABLE):  # spoiled is as good as none
        return None
