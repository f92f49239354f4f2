"""A disk that is full."""

import errno
import os
from pathlib import Path
from typing import Any


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
