"""Where containers of a run find each other and no other containers."""

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
