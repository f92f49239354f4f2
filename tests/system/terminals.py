"""Commands typed in a shell, what they say as pages show it, and the end of what they leave behind."""

import getpass
import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import psutil

from tests.support.waiting import PATIENCE_S, wait_until


class Shell:
    """A shell in a folder of its own that finds ``trade``; what runs in the background ends with the test."""

    def __init__(self, folder: Path, undo: ExitStack, **environment: str) -> None:
        self.folder = folder
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        self.environment = {**os.environ, "PATH": path, "PYTHONUNBUFFERED": "1", **environment}
        self._undo = undo

    def run(self, command: str) -> tuple[int, str]:
        """The exit code of a command, and all that it says, errors too."""
        ended = subprocess.run(
            ["bash", "-c", command],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        return ended.returncode, ended.stdout

    def start(self, command: str) -> "subprocess.Popen[str]":
        """A command that runs beside the others; it can be answered, and Ctrl-C ends it with the test."""
        process = subprocess.Popen(
            ["bash", "-c", f"exec env {command}"],  # variables may stand before it
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._undo.callback(self.end, process)
        return process

    @staticmethod
    def heard(process: "subprocess.Popen[str]", last: str) -> str:
        """What it says, up to the line in which this pattern is."""
        assert process.stdout is not None
        said = ""
        while not re.search(last, said, re.MULTILINE):
            line = process.stdout.readline()
            assert line, f"{process.args} has ended: {said}"
            said += line
        return said

    @staticmethod
    def end(process: "subprocess.Popen[str]") -> None:
        """Ctrl-C, unless it has ended."""
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)


def normalised(text: str, *, numbers: bool = True) -> str:
    """What differs from run to run, put in words; the columns of a table are drawn again around them."""
    head, *rows = lines = text.splitlines()
    if not re.match(r"[A-Z]+(  |$)", head):
        return "".join(f"{in_words(line)}\n" for line in lines)
    starts = [found.start() for found in re.finditer(r"\S+(?: \S+)*", head)]
    spans = list(zip(starts, [*starts[1:], None], strict=True))
    cells = [[in_words(line[a:b].rstrip()) for a, b in spans] for line in (head, *rows)]
    if not numbers:
        cells = [[re.sub(r"^\d[\d./]*$", "N", cell) for cell in row] for row in cells]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "".join("  ".join(map(str.ljust, row, widths)).rstrip() + "\n" for row in cells)


def in_words(text: str) -> str:
    """What differs from run to run: times, ids, processes, who and where one is."""
    for pattern, word in (
        (r"(?<![.\d])\d{15,}\b", "CALL"),
        (r"\b\d\d:\d\d:\d\d\.\d{3}", "TIME"),
        (r"\b[0-9a-f]{12}\b", "EPOCH"),
        (r"\bprocess \d+", "process PID"),
        (r"\b([a-z]+)-\d{3,7}\b", r"\1-PID"),
        (r"/tmp/trade-sim-\w+", "/tmp/trade-sim"),
        (r"\b\d+\.\d m?s\b", "TIME"),
        (rf"\b{re.escape(getpass.getuser())}\b", "USER"),
        (rf"\b{re.escape(socket.gethostname())}\b", "HOST"),
    ):
        text = re.sub(pattern, word, text)
    return re.sub(r"-?\d+\.\d{4,}", lambda found: f"{float(found[0]):.1f}", text)


def end_all_but(before: set[int]) -> None:
    """End the processes of this test's system, which has folders of its own; all but those there were before."""

    def ours() -> list[psutil.Process]:
        found = [one for one in psutil.process_iter() if one.pid not in before]
        return [one for one in found if _folder(one) == os.environ["TRADE_RUNTIME_DIR"]]

    for process in ours():
        process.terminate()
    wait_until(lambda: not ours(), "the system has ended")


def _folder(process: psutil.Process) -> str | None:
    try:
        return None if process.status() == psutil.STATUS_ZOMBIE else process.environ().get("TRADE_RUNTIME_DIR")
    except psutil.Error:
        return None
