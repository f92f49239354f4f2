"""Warnings before the certificate of a container expires."""

import logging
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from typing import Final

from trade._security.certificates import Certificate
from trade._threads.scheduler import NEVER, Scheduler

_logger = logging.getLogger("trade")

_WARN_AHEAD: Final = (timedelta(days=1), timedelta(hours=1))
"""Times before the end at which a warning is logged, each once; times already past at the start cause one warning."""
_LOOK_S: Final = 600.0
"""A computer that slept checks the time again within this interval."""


class ExpiryWatch:
    """Warns before the certificate expires, as long as its timers run."""

    def __init__(
        self, certificate: Certificate, timers: Scheduler, warned: Callable[[str], None] = lambda _: None
    ) -> None:
        """Warn now if it is due; ``warned`` is called with the time of the end."""
        self._certificate = certificate
        self._clock = timers.clock
        self._tell_warned = warned
        self._warned = 0
        timers.due(self._look).by(self._look())

    def _look(self) -> float:
        self._warn()
        if self._warned == len(_WARN_AHEAD):
            return NEVER
        left_s = (self._left() - _WARN_AHEAD[self._warned]).total_seconds()
        return self._clock.now_ns() + min(_LOOK_S, max(0.0, left_s)) * 1e9

    def _left(self) -> timedelta:
        return self._certificate.until - datetime.now(timezone.utc)

    def _warn(self) -> None:
        due = sum(self._left() <= ahead for ahead in _WARN_AHEAD)
        if due > self._warned:
            self._warned = due
            who, until = self._certificate.identity, f"{self._certificate.until:%Y-%m-%d %H:%M} UTC"
            _logger.warning(
                "the certificate of %s ends %s: renew it (`trade pki issue %s`) and start this container again before "
                "that, or all its links end then (`trade gateway` loads the new one by itself)",
                *(who, until, who),
            )
            self._tell_warned(until)
