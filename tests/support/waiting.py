"""Waiting for what other threads and processes do."""

import threading
import time
from collections.abc import Callable

PATIENCE_S = 60.0
_LEAST_S = 0.002


def wait_until(true: Callable[[], object], what: str = "it happened") -> None:
    """Look at a condition until it holds; the only deadline is one no healthy run comes near.

    Looking takes a fifth of the time at most: who is waited for may need the core.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        looked_at = time.monotonic()
        if true():
            return
        now = time.monotonic()
        assert now < deadline, f"waited {PATIENCE_S} s in vain until {what}"
        threading.Event().wait(max(_LEAST_S, 4 * (now - looked_at)))
