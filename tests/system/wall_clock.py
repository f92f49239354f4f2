"""A program whose wall clock is off by as many seconds as a file says: ``wall_clock.py FILE PROGRAM...``.

The file is a double of eight bytes, read again each time; ``PROGRAM`` is a script or ``-m`` and a module, with its
words. The clock that waits go by, `time.monotonic`, is right.
"""

import mmap
import runpy
import struct
import sys
import time
from pathlib import Path

_FORMAT = struct.Struct("d")


def shift(file: Path, by_s: float) -> None:
    """Set the clock of each program that uses this file."""
    with file.open("r+b" if file.exists() else "w+b") as opened:
        opened.write(_FORMAT.pack(by_s))


def _go_by(file: Path) -> None:
    with file.open("rb") as opened:
        said = mmap.mmap(opened.fileno(), _FORMAT.size, access=mmap.ACCESS_READ)
    right, right_ns = time.time, time.time_ns
    time.time = lambda: right() + _FORMAT.unpack_from(said)[0]
    time.time_ns = lambda: right_ns() + int(1e9 * _FORMAT.unpack_from(said)[0])


def main(file: str, program: str, *words: str) -> None:
    _go_by(Path(file))
    if program == "-m":
        sys.argv = [*words]
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = [program, *words]
        runpy.run_path(program, run_name="__main__")


if __name__ == "__main__":
    main(*sys.argv[1:])
