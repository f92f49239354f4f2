"""The camera: an HTTP server on the loopback interface that answers each request with the picture of that moment."""

import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._answer_faults import ActiveFaults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.mechanics._truth import BusState
from trade_hil_sim.robot._bus_thread import BusThread, listener, ready
from trade_robotfile import Camera, Sensor

from ._drawing import draw, png

_SIZE_PX: Final = (320, 240)
_ANSWER_S: Final = 5.0
_CLIENT_S: Final = 1.0
"""How long a client may take to send its request, and to receive the answer."""
_LONGEST_MUTE_S: Final = 60.0
_LONGEST_REQUEST: Final = 8192
_TARGET: Final = "/scene.png"


class SceneCamera(BusThread):
    """A network camera: ``GET /scene.png`` is a picture of the robot. One client is answered after the other.

    Args:
        truth: returns the state of the robot's buses.
        name: of the camera in the robot file.
        width_px: how wide its pictures are.
        height_px: how high.
        log: where to record requests and answers; default: a log in memory, at `log`.
    """

    def __init__(
        self,
        truth: Callable[[], Sequence[BusState]],
        *,
        name: str = "camera",
        width_px: int = _SIZE_PX[0],
        height_px: int = _SIZE_PX[1],
        log: ByteLog | None = None,
    ) -> None:
        super().__init__(name, _ANSWER_S, "camera")
        self.log = ByteLog() if log is None else log
        self._truth, self._size = truth, (width_px, height_px)
        self._lock = threading.Lock()
        self._faults = ActiveFaults()
        self._frozen: bytes | None = None
        self._number = 0
        self._listener: socket.socket | None = None

    @classmethod
    def from_record(
        cls,
        device: Camera | Sensor,
        port: Path,  # noqa: ARG003 - it is reached over the network
        *,
        truth: Callable[[], Sequence[BusState]],
        log: ByteLog | None = None,
        paced: bool = True,  # noqa: ARG003 - a picture takes as long as drawing it takes
    ) -> "SceneCamera":
        """The camera of a robot file, as large as that says.

        Raises:
            SimulationError: it is no camera, or its size is invalid.
        """
        sizes = [device.options.get(key, usual) for key, usual in zip(("width_px", "height_px"), _SIZE_PX, strict=True)]
        width, height = (size if isinstance(size, int) else 0 for size in sizes)
        if not device.key.startswith("camera") or not (0 < width <= 4096 and 0 < height <= 4096):
            raise SimulationError(f"{device.key}: simulated is a camera of 1 to 4096 pixels either way")
        return cls(truth, name=device.name, width_px=width, height_px=height, log=log)

    @property
    def port(self) -> str:
        """The URL of its pictures; final from `open` on."""
        return f"http://127.0.0.1:{self._number}{_TARGET}"

    def state(self) -> BusState:
        """Its state: whether it is plugged in; it has no devices."""
        return BusState(name=self.name, port=self.port, plugged=self._listener is not None)

    def do(self, command: faults.Command) -> None:
        """Carry out a fault or an order: those of answers, ``unplug``, ``replug``, ``freeze`` and ``heal``.

        Raises:
            SimulationError: any other fault.
        """
        match command:
            case faults.Unplug() | faults.Replug():
                self._ask(lambda: self._plug(isinstance(command, faults.Replug)))
            case faults.AnswerFault():
                with self._lock:
                    self._faults.add(command)
            case faults.Unmute():
                with self._lock:
                    self._faults.unmute(None)
            case faults.Freeze():
                picture = self._picture() if command.on else None
                with self._lock:
                    self._frozen = picture
            case faults.Heal():
                with self._lock:
                    self._faults.heal()
                    self._frozen = None
            case _:
                raise SimulationError(f"camera {self.name} has no such thing as {type(command).__name__}")

    def _picture(self) -> bytes:
        return png(draw(self._truth(), *self._size), *self._size)

    # the thread

    def _begin(self) -> None:
        self._listener = listener("127.0.0.1", 0)
        self._number = self._listener.getsockname()[1]

    def _step(self) -> None:
        wake_read, opened = self._errands.wake_read, self._listener
        readable = ready([wake_read] if opened is None else [wake_read, opened.fileno()])
        if wake_read in readable:
            self._errands.run()
        elif opened is not None:
            with suppress(OSError):
                client, _ = opened.accept()
                with client:
                    client.settimeout(_CLIENT_S)
                    self._serve(client)

    def _end(self) -> None:
        self._plug(False)

    def _plug(self, on: bool) -> None:
        if on and self._listener is None:
            self._listener = listener("127.0.0.1", self._number)
        elif not on and self._listener is not None:
            self._listener.close()
            self._listener = None

    def _serve(self, client: socket.socket) -> None:
        request = b""
        while b"\r\n\r\n" not in request:
            data = client.recv(_LONGEST_REQUEST)
            if not data or len(request) > _LONGEST_REQUEST:
                return
            request += data
        line = request.split(b"\r\n")[0].decode("latin-1")
        self._note("received", line)
        answer = self._answer(line)
        with self._lock:
            muted = self._faults.silences(0, "get")
            pieces = [] if muted else self._faults.shape(answer, (0,), "get")
        began = time.monotonic()
        for data, late_s in pieces:
            if not self._patient(client, began + late_s):
                return
            client.sendall(data)
        if muted:
            self._patient(client, began + _LONGEST_MUTE_S)
        self._note("sent", f"{sum(len(piece.data) for piece in pieces)} bytes")

    def _patient(self, client: socket.socket, until: float) -> bool:
        """Wait; False if the client disconnects first, or the camera is woken."""
        left_s = until - time.monotonic()
        return left_s <= 0 or not ready([client.fileno(), self._errands.wake_read], timeout_s=left_s)

    def _answer(self, line: str) -> bytes:
        if line.split(" ")[:2] != ["GET", _TARGET]:
            return b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n"
        picture = self._frozen or self._picture()
        head = f"HTTP/1.0 200 OK\r\nContent-Type: image/png\r\nContent-Length: {len(picture)}\r\n\r\n"
        return head.encode("ascii") + picture

    def _note(self, name: str, detail: str) -> None:
        self.log.add(LogEntry(t=time.monotonic(), bus=self.name, kind="event", name=name, detail=detail))
