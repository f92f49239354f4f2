"""The admission of drives to the cycle, at attach and after losses, as a state machine that never blocks."""

import logging
from typing import TYPE_CHECKING, Final

from trade_drivers.bus._cycle import PROBE_NS
from trade_drivers.joints import Unfit
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis, Stage
from trade_drivers.vendors.cia402._inspect import set_up
from trade_drivers.vendors.cia402._net import NoAnswer, Refused

if TYPE_CHECKING:
    from trade_drivers.vendors.cia402._cycle import DriveExchange
    from trade_robotfile import CanBus

_log = logging.getLogger("trade")
_UNHEARD_NS: Final = 2_000_000_000
"""The wait for a drive's frames after set-up, before it is set up again."""


class Admission:
    """The admission of one drive. It enables nothing and moves nothing.

    | stage       | what happens                           | and then                                              |
    |-------------|----------------------------------------|-------------------------------------------------------|
    | AWAY        | nothing, until its turn comes          | LOOKED_OVER                                           |
    | LOOKED_OVER | one request after the other            | SET_UP; AWAY for a while, if it is silent or unfit    |
    | SET_UP      | its heartbeat and measurements awaited | HERE; AWAY, with that as its fault, if they stay away |
    | HERE        | it is measured in every cycle          |                                                       |

    Each stage changes to AWAY when the drive restarts, or when the drive or the port is gone.
    """

    def __init__(self, exchange: "DriveExchange", axis: DriveAxis, bus: "CanBus") -> None:
        self.axis = axis
        self._exchange = exchange
        self._bus = bus
        self._recall_at_ns = 0
        self._steps = set_up(exchange.nodes, axis, bus)

    def advance(self) -> None:
        """Advances as far as possible without waiting."""
        match self.axis.stage:
            case Stage.AWAY:
                self._begin()
            case Stage.LOOKED_OVER:
                self._look_over()
            case Stage.SET_UP:
                self._await()
            case Stage.HERE:
                pass

    def recall(self) -> None:
        """Restarts a drive that network management has stopped; repeats, since the command has no confirmation."""
        axis, now_ns = self.axis, self._exchange.clock()
        if axis.stopped and now_ns >= self._recall_at_ns:
            _log.warning("%s: network management has stopped it; it is put to pre-operational and set up", axis.name)
            self._exchange.nodes.command(axis.id, table.NMT_PREOPERATIONAL)
            self._recall_at_ns, axis.probe_at_ns = now_ns + PROBE_NS, now_ns

    def _begin(self) -> None:
        axis, exchange = self.axis, self._exchange
        busy = exchange.worked_on(axis) and not axis.recalled  # a drive answers only one of two requests
        if exchange.clock() >= axis.probe_at_ns and not busy:
            axis.stage, self._steps = Stage.LOOKED_OVER, set_up(exchange.nodes, axis, self._bus)
            self._look_over()

    def _look_over(self) -> None:
        try:
            next(self._steps)
        except StopIteration:
            self.axis.be_awaited(self._exchange.clock())
            self._exchange.beat_next()
        except NoAnswer as silent:
            self.axis.unfit = ""
            self._try_later(silent)
        except (Unfit, Refused) as unfit:
            self.axis.fault = self.axis.unfit = str(unfit)  # replaces an earlier fault, as this must be fixed first
            self._try_later(unfit)

    def _await(self) -> None:
        axis, now_ns = self.axis, self._exchange.clock()
        if axis.to_start:
            axis.to_start = False
            self._exchange.nodes.command(axis.id, table.NMT_START)
        if not axis.unheard:
            _log.info("%s answers on %s", axis.name, axis.bus)
            axis.welcome(now_ns)
        elif now_ns - axis.set_up_ns > max(_UNHEARD_NS, 2 * self._exchange.deaf_ns):
            problem = Unfit(f"node {axis.id} answers, but sends {axis.unheard}; a drive without it cannot be used")
            self._exchange.problems[axis] = problem
            axis.fault, axis.ready = str(problem), False
            axis.forget(now_ns)

    def _try_later(self, problem: Exception) -> None:
        self._exchange.problems[self.axis] = problem
        now_ns = self._exchange.clock()
        self.axis.forget(now_ns)
        self.axis.probe_at_ns = now_ns + PROBE_NS
