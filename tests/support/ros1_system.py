"""A ROS 1 system of a test's own: the master of the distribution, and rospy nodes that follow commands."""

import json
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.support.waiting import wait_until

PYTHON = "/usr/bin/python3"
_PEER = Path(__file__).parents[1] / "unit" / "ros" / "ros1" / "peer.py"
_NEEDED = "import rospy, rosmaster, actionlib, move_base_msgs.msg, sensor_msgs.msg, std_srvs.srv, trajectory_msgs.msg"
_END_S = 30.0


def need_ros1() -> None:
    """Skip where there is no ROS 1, and fail there in CI."""
    try:
        tried = subprocess.run([PYTHON, "-c", _NEEDED], capture_output=True, timeout=60, check=False)
        why = tried.stderr.decode().strip().rpartition("\n")[2] or f"{PYTHON} ends with {tried.returncode}"
        said = why if tried.returncode else ""
    except OSError as error:
        said = str(error)
    if said:
        reason = f"there is no ROS 1: {said}"
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)


class Peer:
    """A rospy node that takes commands as lines; what it reports is in `reported`."""

    def __init__(self, stand: "Stand", name: str) -> None:
        self.name = f"/{name}"
        self.reported: list[dict[str, Any]] = []
        self._process = subprocess.Popen(
            [PYTHON, str(_PEER), name],
            env=stand.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, name=f"peer-{name}")
        self._reader.start()
        self.wait_for("ready")

    @property
    def pid(self) -> int:
        return self._process.pid

    def do(self, what: str, *args: object) -> None:
        """Send it a command; `wait_for` waits for what it reports."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([what, *args]) + "\n")
        self._process.stdin.flush()

    def all(self, event: str) -> list[Any]:
        return [reported["what"] for reported in list(self.reported) if reported["event"] == event]

    def wait_for(self, event: str, true: Callable[[Any], object] = lambda _: True) -> Any:
        wait_until(
            lambda: any(true(what) for what in self.all(event)), f"{self.name} reported {event}: {self.reported[-5:]}"
        )
        return next(what for what in self.all(event) if true(what))

    def freeze(self) -> None:
        self._process.send_signal(signal.SIGSTOP)

    def end(self, how: int = signal.SIGKILL) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
            self._process.send_signal(how)
        self._process.wait(_END_S)
        self._reader.join(_END_S)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with suppress(BrokenPipeError):
                pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self.reported.append(json.loads(line))


class Stand:
    """The master and its nodes."""

    def __init__(self, home: Path) -> None:
        self._port = _free_port()
        self._peers: list[Peer] = []
        self._master: subprocess.Popen[bytes] | None = None
        self.uri = f"http://127.0.0.1:{self._port}"
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "ROS_"))},
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(home),
            "ROS_LOG_DIR": str(home),
            "PYTHONUNBUFFERED": "1",
        }

    def start_master(self) -> None:
        self._master = subprocess.Popen(
            [PYTHON, "/usr/bin/rosmaster", "--core", "-p", str(self._port)],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_until(self._answers, "the master listens")

    def kill_master(self) -> None:
        if self._master is not None:
            self._master.kill()
            self._master.wait(_END_S)
            self._master = None

    def peer(self, name: str) -> Peer:
        self._peers.append(Peer(self, name))
        return self._peers[-1]

    def close(self) -> None:
        for peer in self._peers:
            peer.end()
        self.kill_master()

    def _answers(self) -> bool:
        assert self._master is not None
        assert self._master.poll() is None, "the master has ended"
        with socket.socket() as tried:
            return tried.connect_ex(("127.0.0.1", self._port)) == 0


def our_node() -> psutil.Process:
    """The child that is our node."""
    (found,) = [child for child in psutil.Process().children() if "/trade" in _words(child)]
    return found


def _words(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:  # or it is one that has ended
        return []


def _free_port() -> int:
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        return int(tried.getsockname()[1])
