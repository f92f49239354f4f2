"""How a controller is reached: through two child processes, one that reads and one that commands."""

import time
from typing import Final

from trade_drivers._work import PortLost
from trade_drivers.ur._child import Child
from trade_drivers.ur._dashboard import DashboardError, probe
from trade_drivers.ur._messages import Gone

__all__ = ["Link"]

_PROBE_S: Final = 1.0
_FIRST_S: Final = 10.0
"""A process that reads has to import the library first, on a machine that may be busy."""
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

    def open(self) -> None:
        """See that the controller answers, then have its states read; nothing is commanded, and no script runs.

        Raises:
            PortLost: it does not answer.
        """
        self.close()
        try:
            probe(self.path, _PROBE_S)
        except DashboardError as problem:
            raise PortLost(str(problem)) from None
        self.states, self.control = Child("states", self.path), Child("control", self.path)
        until = time.monotonic() + _FIRST_S
        try:
            while not (self.states.samples and self.control.ready):
                if time.monotonic() > until:
                    raise PortLost("it sends no states")
                time.sleep(_LOOK_S)
                self.states.listen()
                self.control.listen()
        except Gone as gone:
            raise PortLost(f"its states cannot be read: {gone}") from None
        finally:
            if not (self.states.samples and self.control.ready):
                self.close()

    def renew_control(self) -> None:
        """Replace the process that commands by one that has no control."""
        if self.control is not None:
            self.control.kill()
            self.control = Child("control", self.path)

    def close(self) -> None:
        """End both; the one that commands stops what it moves. More than once is fine."""
        states, self.states = self.states, None
        control, self.control = self.control, None
        if control is not None:
            control.end(_END_S)
        if states is not None:
            states.kill()
