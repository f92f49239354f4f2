"""A child process as the driver sees it: started, spoken to, and killed when it is of no more use."""

import subprocess
import sys
from contextlib import suppress
from typing import Final, Literal

from trade_drivers.vendors.ur._messages import Channel, Done, Failed, Gone, Hello, Order, Pulse, Report, Sample, pair

__all__ = ["Child"]

_END_S: Final = 5.0


class Child:
    """One process that speaks to a controller through the vendor's library.

    Args:
        role: ``control`` or ``states``.
        host: the controller.
    """

    def __init__(self, role: Literal["control", "states"], host: str) -> None:
        ours, theirs = pair()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-m", f"trade_drivers.vendors.ur._{role}_child", str(theirs.fileno()), host],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # the library's own words, from threads of its own
                stderr=subprocess.DEVNULL,
            )
        self._channel: Channel[Report] = Channel(ours, Report)
        self._numbers = 0
        self._answers: dict[int, Done] = {}
        self.ready = False
        """It has said that it takes orders."""
        self.problem = ""
        """Why it ended, if it said so."""
        self.running = False
        """As it last said: a move it began is under way."""
        self.pulses = 0
        """How often it has said so."""
        self.samples: list[Sample] = []
        """What it measured, since they were last taken."""

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def number(self) -> int:
        """For the next order that is to be answered."""
        self._numbers += 1
        return self._numbers

    def send(self, order: Order) -> None:
        """Tell it something; raises ``Gone``."""
        self._channel.send(order)

    def listen(self) -> None:
        """Take in what it has said; raises ``Gone``, with why if it said so."""
        try:
            self._take_in()
        except Gone as gone:
            raise Gone(self.problem or str(gone)) from None

    def _take_in(self) -> None:
        for word in self._channel.waiting():
            match word:
                case Failed():
                    self.problem = word.problem
                case Sample():
                    self.samples.append(word)
                case Pulse():
                    self.running = word.running
                    self.pulses += 1
                case Done():
                    self._answers[word.number] = word
                case Hello():
                    self.ready = True

    def answer(self, number: int) -> Done | None:
        """What became of an order, once it is known."""
        return self._answers.pop(number, None)

    def end(self, patience_s: float) -> None:
        """Let it end by itself, which stops what it set moving; kill it if it does not."""
        self._channel.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        self.kill()

    def kill(self) -> None:
        """End it at once; more than once is fine."""
        self._process.kill()
        self._channel.close()
        self._process.wait(_END_S)
