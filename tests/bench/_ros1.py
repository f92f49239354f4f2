"""ROS 1: a service of rospy, called over a connection that stays. Under the Python that ROS is installed for.

Only the bench's own modules are imported here, as that Python has none of our libraries.
"""

import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache

from tests.bench._links import Call, Link, Peer, Threads

_PYTHON = "/usr/bin/python3"
_NEEDED = "import rospy, rosmaster, std_msgs.msg"
_MASTER = "/usr/bin/rosmaster"
_PATIENCE_S = 20.0
_SERVICE = "bench_echo"


class Rospy(Peer):
    """Bytes as they are: an array of uint8 in both directions, no definition beyond that of std_msgs."""

    name = "rospy"
    python = _PYTHON

    @property
    def missing(self) -> str:
        return _missing()

    @contextmanager
    def serve(self) -> Iterator[str]:
        with _master() as uri:
            import rospy

            _begin_node("server", uri)
            service = rospy.Service(_SERVICE, _kind(), lambda request: request)
            yield uri
            service.shutdown()

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        import rospy

        _begin_node("caller", address)
        rospy.wait_for_service(_SERVICE, _PATIENCE_S)
        with ExitStack() as stack:
            yield _Proxies(stack)


class _Proxies(Threads):
    """A proxy for each thread: one is not made for several."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._calls: list[Call] = []

    def call(self, payload: bytes) -> bytes:
        return self.several(1)[0](payload)

    def several(self, count: int) -> Sequence[Call]:
        import rospy

        while len(self._calls) < count:
            proxy = rospy.ServiceProxy(_SERVICE, _kind(), persistent=True)
            self._stack.callback(proxy.close)
            self._calls.append(lambda payload, proxy=proxy: proxy(data=payload).data)
        return self._calls[:count]


@cache
def _missing() -> str:
    try:
        tried = subprocess.run([_PYTHON, "-c", _NEEDED], capture_output=True, timeout=60, check=False)
    except OSError as error:
        return str(error)
    why = tried.stderr.decode().strip().rpartition("\n")[2]
    return f"there is no ROS 1: {why}" if tried.returncode else ""


def _kind() -> type:
    """A service as rospy wants one described; its sum is ours to choose, as long as both ends have the same."""
    from std_msgs.msg import UInt8MultiArray

    parts = {"_type": "bench/Echo", "_md5sum": 32 * "b", "_request_class": UInt8MultiArray}
    return type("Echo", (), {**parts, "_response_class": UInt8MultiArray})


def _begin_node(name: str, uri: str) -> None:
    import rospy

    os.environ.update(ROS_MASTER_URI=uri, ROS_IP="127.0.0.1", ROS_LOG_DIR=tempfile.gettempdir())
    rospy.init_node(name, disable_signals=True, disable_rostime=True)


@contextmanager
def _master() -> Iterator[str]:
    """The address of a master of its own. Raises RuntimeError if it does not come up."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "ROS_LOG_DIR": folder, "ROS_HOME": folder, "ROS_IP": "127.0.0.1"}
        command = [_PYTHON, _MASTER, "--core", "-p", str(port)]
        quiet = subprocess.DEVNULL
        process = subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet)
        try:
            _wait_until_listening(port)
            yield f"http://127.0.0.1:{port}"
        finally:
            process.kill()
            process.wait()


def _wait_until_listening(port: int) -> None:
    until = time.monotonic() + _PATIENCE_S
    while True:
        with socket.socket() as tried:
            if tried.connect_ex(("127.0.0.1", port)) == 0:
                return
        if time.monotonic() > until:
            raise RuntimeError("the master of ROS does not answer")
        time.sleep(0.05)
