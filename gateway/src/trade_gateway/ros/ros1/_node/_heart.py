"""The sign that this process lives, for TRADE, which ends and starts again one that stands still."""

from __future__ import annotations

import threading
import time

from ._frames import Channel

__all__ = ["Heart"]

_EVERY_S = 0.5
_STUCK_S = 60.0
"""Every question to a master has a deadline; work that is not done again for so long never will be."""


class Heart:
    """Beats on a thread of its own, whatever others wait for, as long as the work goes on at all."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._worked_at = time.monotonic()
        self.thread = threading.Thread(target=self._beat, name="heart", daemon=True)
        self.thread.start()

    def worked(self) -> None:
        """The work goes on."""
        self._worked_at = time.monotonic()

    def _beat(self) -> None:
        while time.monotonic() - self._worked_at < _STUCK_S:
            self._channel.put({"op": "alive"}, key="alive", most=1)
            time.sleep(_EVERY_S)
