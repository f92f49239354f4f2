"""A real ROS 2: its router, ros2cli, and nodes of rclpy, each a process of its own.

It is a ``ros2`` on PATH with rmw_zenoh_cpp, or the command of TEST_ROS2, in whose environment there is one.
"""

import json
import os
import shlex
import shutil
import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import pytest

from tests.support.ros2_processes import free_port
from tests.support.waiting import PATIENCE_S, wait_until

_PYTHON: Final = "/usr/bin/python3"
_CLI: Final = "import sys; from ros2cli.cli import main; sys.exit(main())"
"""What the script ``ros2`` runs; its first line may name a Python of another computer."""


def command() -> list[str]:
    """What runs a program in the environment of ROS 2. Skips the test where there is none."""
    if said := os.environ.get("TEST_ROS2"):
        return shlex.split(said)
    if shutil.which("ros2"):
        return []
    pytest.skip("no ROS 2: there is no `ros2` on PATH, and TEST_ROS2 names no command that has one")


class RealRos2:
    """A router of its own, and what is started beside it."""

    def __init__(self) -> None:
        self._command = command()
        self._port = free_port()
        self.endpoint: Final = f"tcp/127.0.0.1:{self._port}"
        self._programs: list[RosProgram] = []
        listen = f'listen/endpoints=["tcp/127.0.0.1:{self._port}"]'
        self._router = self._begin(["rmw_zenohd"], {"ZENOH_CONFIG_OVERRIDE": listen}, name="rmw_zenohd")

    def _environment(self) -> dict[str, str]:
        connect = f'mode="client";connect/endpoints=["tcp/127.0.0.1:{self._port}"]'
        return {"ZENOH_CONFIG_OVERRIDE": connect, "RMW_IMPLEMENTATION": "rmw_zenoh_cpp", "ROS_DOMAIN_ID": "0"}

    def _begin(self, words: list[str], environment: dict[str, str], name: str) -> "RosProgram":
        made = RosProgram([*self._command, *words], {**os.environ, **environment}, name)
        self._programs.append(made)
        return made

    def ros2(self, *words: str) -> "RosProgram":
        """A command of ros2cli."""
        return self._begin([_PYTHON, "-c", _CLI, *words], self._environment(), f"ros2 {words[0]}")

    def node(self, *words: str) -> "RosProgram":
        """The nodes of ``ros2_rclpy_node``, which say JSON."""
        script = Path(__file__).with_name("ros2_rclpy_node.py")
        return self._begin([_PYTHON, str(script), *words], self._environment(), "rclpy")

    def close(self) -> None:
        """Ends all."""
        for program in reversed(self._programs):
            program.kill()


class RosProgram:
    """A program that can be killed, and what it has said."""

    def __init__(self, words: list[str], environment: dict[str, str], name: str) -> None:
        self.lines: list[str] = []
        self._name = name
        environment.pop("PYTHONPATH", None)
        self._process = subprocess.Popen(
            words,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, name=f"reads {name}", daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self.lines.extend(iter(self._process.stdout.readline, ""))

    @property
    def text(self) -> str:
        """All that it has said."""
        return "".join(list(self.lines))

    def ended(self) -> str:
        """Wait for its end; what it has said."""
        self._process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return self.text

    def hear(self, what: str) -> dict[str, Any]:
        """Wait until it reports something as JSON; the first such report."""
        wait_until(lambda: bool(self.has(what)), f"{self._name} reports {what}; it said {self.text}")
        return self.has(what)[0]

    def has(self, what: str) -> list[dict[str, Any]]:
        """Its reports of something."""
        said = [json.loads(line) for line in list(self.lines) if line.startswith("{")]
        return [one for one in said if one["what"] == what]

    def kill(self) -> None:
        """As ``kill -9`` does. Idempotent."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, 9)
        self._process.wait()
        self._reader.join(PATIENCE_S)
        for end in (self._process.stdin, self._process.stdout):
            if end is not None:
                with suppress(BrokenPipeError):
                    end.close()
