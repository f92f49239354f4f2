"""The connection to a controller: two child processes, one that reads and one that commands."""

import threading
import time
from typing import Final

from trade_drivers.bus._jobs import PortLost, PortOpening
from trade_drivers.vendors.ur._child import Child
from trade_drivers.vendors.ur._messages import Disconnected

_FIRST_S: Final = 10.0
"""Startup time of a reading process, which imports the library on a possibly busy machine."""
_LOOK_S: Final = 0.01
_END_S: Final = 1.0


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
            self._ending = threading.Thread(target=control.end, args=(_END_S,), name=f"ending {self.path}", daemon=True)
            self._ending.start()
        if states is not None:
            states.kill()

    def wait_closed(self) -> None:
        """Waits until both have ended."""
        if self._ending is not None:
            self._ending.join()
