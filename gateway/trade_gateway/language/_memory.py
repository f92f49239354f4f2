"""The services at the last look, so that a question can be about what has changed since."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from trade.atomic_files import replace
from trade.protocol.messages import UNREADABLE

_MOST_BYTES: Final = 16 << 20


class Memory:
    """The services at the last look and their containers, in a file or in this object only.

    Args:
        path: the file, which need not exist; None: nothing is stored.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._known: Mapping[str, str] | None = None if path is None else _read(path)

    def news(self, services: Mapping[str, str]) -> tuple[list[str], list[str]] | None:
        """Returns the services that joined and left since the last look; None at the first one.

        Args:
            services: the present services, and the container of each.
        """
        before, self._known = self._known, dict(services)
        if self._path is not None:
            with contextlib.suppress(OSError):  # an unsaved change is reported again
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
    except (OSError, *UNREADABLE):  # a damaged file counts as none
        return None
