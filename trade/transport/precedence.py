"""Precedence of threads: on a busy computer, Linux gives them a processor before ordinary ones."""

import contextlib
import logging
import os
import sys
from collections.abc import Generator
from typing import Final

_logger = logging.getLogger("trade")

NICE: Final = -10
"""The weight of nine ordinary threads, as `nice(1)` counts. Threads in real time still come first."""


@contextlib.contextmanager
def precedence(of: str) -> Generator[None]:
    """Threads that begin meanwhile, and those that they start, precede ordinary ones, if the system allows it.

    Args:
        of: what begins, for the log if it is refused.
    """
    if sys.platform != "linux":  # elsewhere, processes are nice, not threads
        yield
        return
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(before, NICE))
    except PermissionError as refused:
        _logger.info(
            "%s has no precedence before other programs (%s): with very many containers, allow it a nice value of %d",
            *(of, refused.strerror, NICE),
        )
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)
