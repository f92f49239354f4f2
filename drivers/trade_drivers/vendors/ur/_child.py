"""The driver's handle of a child process: start, messages, and end."""

import subprocess
import sys
from contextlib import suppress
from typing import Final, Literal

from trade_drivers.vendors.ur._messages import (
    Channel,
    Disconnected,
    Done,
    Failed,
    HeartbeatAnswer,
    Hello,
    Order,
    Report,
    Sample,
    pair,
)

_END_S: Final = 5.0


class Child:
    """One process that communicates with a controller through the vendor's library.

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
        self.pulses = 0
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
                    self.pulses += 1
                case Done():
                    self._answers[word.number] = word
                case Hello():
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
        self._process.wait(_END_S)
