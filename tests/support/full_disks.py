"""Disks that are full: a file that takes no more, and a file system of its own."""

import contextlib
import errno
import os
import subprocess
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest


class FullDisk:
    """A new file that takes so many bytes; what is cut off is room again."""

    def __init__(self, path: Path, room: int) -> None:
        self._file = path.open("xb", buffering=0)
        self._room = room

    def write(self, data: Any, /) -> int:
        left = self._room - self._file.tell()
        if left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._file.write(memoryview(data)[:left]) or 0

    def tell(self) -> int:
        return self._file.tell()

    def seek(self, offset: int, /) -> int:
        return self._file.seek(offset)

    def truncate(self, size: int, /) -> int:
        return self._file.truncate(size)

    def close(self) -> None:
        self._file.close()


class SmallDisk:
    """A file system with room for little."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / "filler"

    def fill(self) -> None:
        """From now on nothing more can be written."""
        with self._filler.open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(4096))

    def make_room(self) -> None:
        """It was only this file that took it all."""
        self._filler.unlink()


@contextlib.contextmanager
def small_disk(folder: Path) -> Generator[SmallDisk]:
    """One that is mounted at a folder, which is made; skips where nothing can be mounted."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m,mode=700", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounting a disk takes root, and a system that lets it")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
