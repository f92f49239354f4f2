"""The end of a container's certificate, told in time: it listens with the one it was started with, renewed or not."""

import logging
import threading
from datetime import datetime, timedelta, timezone
from typing import Final

from trade._security.certificates import Certificate

_logger = logging.getLogger("trade")

_TOLD: Final = (timedelta(days=1), timedelta(hours=1))
"""How long before the end it is told, each once; what has passed already at the start is told as one."""
_LOOK_S: Final = 600.0
"""A computer that slept finds out by then what time it is."""


class ExpiryWatch:
    """Warns until it is closed."""

    def __init__(self, certificate: Certificate) -> None:
        self._certificate = certificate
        self._told = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="trade-certificate", daemon=True)
        self._tell()
        self._thread.start()

    def _run(self) -> None:
        while self._told < len(_TOLD) and not self._closed.wait(self._until_next_s()):
            self._tell()

    def _until_next_s(self) -> float:
        left = self._left() - _TOLD[self._told]
        return min(_LOOK_S, max(0.0, left.total_seconds()))

    def _left(self) -> timedelta:
        return self._certificate.until - datetime.now(timezone.utc)

    def _tell(self) -> None:
        due = sum(self._left() <= ahead for ahead in _TOLD)
        if due > self._told:
            self._told = due
            who, until = self._certificate.identity, f"{self._certificate.until:%Y-%m-%d %H:%M} UTC"
            _logger.warning(
                "the certificate of %s ends %s: renew it (trade pki issue %s) and start this container again before "
                "that (`trade gateway` takes the new one by itself); it listens with the one it was started with, "
                "and else all its links end then",
                *(who, until, who),
            )

    def close(self) -> None:
        """End the thread. Idempotent."""
        self._closed.set()
        self._thread.join(2)
