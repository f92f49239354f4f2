"""Where the processes of a run find each other and no others, and which processors they use."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock


@contextmanager
def own_folder() -> Iterator[None]:
    """A runtime folder of this run alone; child processes inherit it."""
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, TRADE_RUNTIME_DIR=folder):
        yield


@contextmanager
def on_one_processor() -> Iterator[None]:
    """Processes that begin meanwhile stay on one processor, where the system lets a process choose."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
