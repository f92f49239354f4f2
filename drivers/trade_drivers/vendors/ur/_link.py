"""The connection to a controller: two child processes, one that reads and one that commands."""

import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Final, Literal

from trade_drivers.bus._jobs import PortLost, PortOpening
from trade_drivers.vendors.ur._messages import (
    Channel,
    Disconnected,
    Done,
    Failed,
    HeartbeatAnswer,
    Order,
    Ready,
    Report,
    Sample,
    pair,
)

_FIRST_S: Final = 10.0
"""Startup time of a reading process, which imports the library on a possibly busy machine."""
_LOOK_S: Final = 0.01
_ENDED_S: Final = 1.0
"""How long the process that commands may take to stop its motion and end."""
_KILLED_S: Final = 5.0


class Child:
    """The driver's handle of one process, which communicates with a controller through the vendor's library.

    Args:
        role: ``control`` or ``states``.
        host: the controller.
    """

    def __init__(self, role: Literal["control", "states"], host: str) -> None:
        own_end, child_end = pair()
        with child_end:
            self._process = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-m", f"trade_drivers.vendors.ur._{role}_child", str(child_end.fileno()), host],
                pass_fds=[child_end.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # output of the library's own threads
                stderr=subprocess.DEVNULL,
            )
        self._channel: Channel[Report] = Channel(own_end, Report)
        self._numbers = 0
        self._answers: dict[int, Done] = {}
        self.ready = False
        """True after it has reported that it accepts orders."""
        self.problem = ""
        """The reported reason of its end."""
        self.running = False
        """True while it reports a running move."""
        self.heartbeat_answers = 0
        """Number of those reports."""
        self.samples: list[Sample] = []
        """Measurements that have not been taken yet."""

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def number(self) -> int:
        """Returns the number for the next order with an answer."""
        self._numbers += 1
        return self._numbers

    def send(self, order: Order) -> None:
        """Sends it a message; raises ``Disconnected``."""
        self._channel.send(order)

    def listen(self) -> None:
        """Processes its messages; raises ``Disconnected``, with the reason if it reported one."""
        try:
            self._take_in()
        except Disconnected as gone:
            raise Disconnected(self.problem or str(gone)) from None

    def _take_in(self) -> None:
        for word in self._channel.waiting():
            match word:
                case Failed():
                    self.problem = word.problem
                case Sample():
                    self.samples.append(word)
                case HeartbeatAnswer():
                    self.running = word.running
                    self.heartbeat_answers += 1
                case Done():
                    self._answers[word.number] = word
                case Ready():
                    self.ready = True

    def answer(self, number: int) -> Done | None:
        """Returns the outcome of an order, once it is known."""
        return self._answers.pop(number, None)

    def end(self, patience_s: float) -> None:
        """Requests its end, which stops its motion; kills it if it does not end."""
        self._channel.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        self.kill()

    def kill(self) -> None:
        """Kills it. Idempotent."""
        self._process.kill()
        self._channel.close()
        self._process.wait(_KILLED_S)


class Link:
    """The two processes.

    Args:
        host: the controller.
    """

    def __init__(self, host: str) -> None:
        self.path = host
        self.states: Child | None = None
        self.control: Child | None = None
        self._until = 0.0
        self._ending: threading.Thread | None = None

    def open(self) -> None:
        """Advances the connection of the reading process without waiting; commands nothing and runs no script.

        Raises:
            PortOpening: no states have arrived yet.
            PortLost: the controller does not answer; the next call tries again.
        """
        if self._ending is not None and self._ending.is_alive():
            raise PortOpening("the process that commanded it has not ended yet")
        if self.states is None or self.control is None:
            self.states, self.control = Child("states", self.path), Child("control", self.path)
            self._until = time.monotonic() + _FIRST_S
        try:
            self.states.listen()
            self.control.listen()
        except Disconnected as gone:
            self.close()
            raise PortLost(f"its states cannot be read: {gone}") from None
        if self.states.samples and self.control.ready:
            return
        if time.monotonic() > self._until:
            self.close()
            raise PortLost("it sends no states")
        raise PortOpening("its states are not read yet")

    def wait_open(self) -> None:
        """Waits for the connection; raises ``PortLost``."""
        while True:
            try:
                return self.open()
            except PortOpening:
                time.sleep(_LOOK_S)

    def renew_control(self) -> None:
        """Replaces the process that commands by one without control."""
        if self.control is not None:
            self.control.kill()
            self.control = Child("control", self.path)

    def close(self) -> None:
        """Ends both processes without waiting for the one that commands, which stops its motion. Idempotent."""
        states, self.states = self.states, None
        control, self.control = self.control, None
        if control is not None:
            name = f"ending {self.path}"
            self._ending = threading.Thread(target=control.end, args=(_ENDED_S,), name=name, daemon=True)
            self._ending.start()
        if states is not None:
            states.kill()

    def wait_closed(self) -> None:
        """Waits until both have ended."""
        if self._ending is not None:
            self._ending.join()
