"""The client of the stop line: it asks all reachable places at once, and merges the answers."""

import contextlib
import logging
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, Generic, TypeVar

from trade._estop.broadcast import EstopReport, all_of, as_seen_here
from trade._settings import Settings
from trade.protocol.messages import Malformed
from trade.stop_line.group_stop import StopReport, merge_reports
from trade.stop_line.messages import LONGEST_REASON, VERSION, StopAnswer, StopRequest, encoded, read_answer
from trade.stop_line.places import Place, places
from trade.transport.endpoints import accepts

_logger = logging.getLogger("trade")

_THREADS: Final = 32
_RELAYS: Final = 4
"""How many containers on this host pass an e-stop on with their own orders; the others stop only themselves."""
_CONNECT_S: Final = 1.0
_MOST_BYTES: Final = 1 << 20
_REACH_S: Final = 0.8
"""How long a place may take to accept a connection once all others have confirmed: a dead address delays no report."""
_POLL_S: Final = 0.02
_Report = TypeVar("_Report", EstopReport, StopReport)


class LineCall(Generic[_Report]):
    """A request to several places, under way."""

    def __init__(
        self,
        requests: Sequence[tuple[Place, StopRequest]],
        limit_s: float,
        report_of: Callable[[StopAnswer], _Report | None],
        merge: Callable[[list[_Report]], _Report],
    ) -> None:
        self._reach_until = time.monotonic() + _REACH_S
        self._until = time.monotonic() + limit_s
        self._report_of = report_of
        self._merge = merge
        self._reports: list[_Report] = []
        self._remaining = len(requests)
        self._waiting = deque(requests)
        self._changed = threading.Condition()
        self._unreached = {place.name for place, _ in requests if place.path is None}
        self._pending = {place.name for place, _ in requests if place.path is not None}
        """The places that have accepted a connection, or are on this host, and that have not answered yet."""
        self.problems: Final[dict[str, str]] = {}
        """Places that did not answer, and why."""
        for _ in range(min(_THREADS, len(requests))):
            threading.Thread(target=self._work, name="trade-stop-ask", daemon=True).start()

    def report(self) -> _Report:
        """The answers so far, merged."""
        with self._changed:
            return self._merge(list(self._reports))

    def is_done(self) -> bool:
        """Whether all have answered or failed."""
        return self._remaining == 0

    def wait(self) -> _Report:
        """Waits until all have answered, or the time is over; returns the answers, merged."""
        with self._changed:
            self._changed.wait_for(self.is_done, max(0.0, self._until - time.monotonic()))
        return self.report()

    def unreached(self) -> list[str]:
        """The places on networks that have not accepted a connection so far."""
        with self._changed:
            return sorted(self._unreached)

    def is_enough(self) -> bool:
        """Whether the report is complete, and all places that accept a connection have answered."""
        with self._changed:
            reached_all = self.is_done() or (not self._pending and time.monotonic() >= self._reach_until)
            return reached_all and self.problems.keys() <= self._unreached and self._merge(list(self._reports)).complete

    def wait_enough(self, incomplete_s: float = math.inf) -> _Report:
        """Waits as `wait` does, but not for places that accept no connection, once all others have confirmed.

        Args:
            incomplete_s: after this time in seconds, it does not wait for a report that is still incomplete.
        """
        patient_until = time.monotonic() + incomplete_s
        while not (self.is_done() or self.is_enough()) and (left_s := self._until - time.monotonic()) > 0:
            if time.monotonic() >= patient_until and not self.report().complete:
                break
            with self._changed:
                self._changed.wait(min(_POLL_S, left_s))
        return self.report()

    def _work(self) -> None:
        while True:
            try:
                place, request = self._waiting.popleft()
            except IndexError:
                return
            self._ask(place, request)

    def _ask(self, place: Place, request: StopRequest) -> None:
        report, problem = None, "its answer is missing"
        try:
            plain = place.dial(min(_CONNECT_S, self._left_s()))
            with self._changed:
                self._unreached.discard(place.name)
                self._pending.add(place.name)
            with place.secured(plain) as sock:
                sock.sendall(encoded(request))
                for answer in _answers(sock, self._left_s):
                    problem = f"{answer.error}: {answer.why}" if answer.error else problem
                    report = self._report_of(answer) or report
        except (OSError, Malformed, ValueError) as bad:
            problem = str(bad) or type(bad).__name__
        with self._changed:
            self._pending.discard(place.name)
            if report is None:
                self.problems[place.name] = problem
                _logger.debug("no answer on the stop line at %s: %s", place.name, problem)
            else:
                self._reports.append(report)
            self._remaining -= 1
            self._changed.notify_all()

    def _left_s(self) -> float:
        return max(0.01, self._until - time.monotonic())


def _answers(sock: socket.socket, left_s: Callable[[], float]) -> "deque[StopAnswer]":
    """All answers until the other end closes."""
    received, found = bytearray(), deque[StopAnswer]()
    while len(received) <= _MOST_BYTES:
        sock.settimeout(left_s())
        more = sock.recv(65536)
        if not more:
            break
        received += more
    for line in received.splitlines():
        with contextlib.suppress(Malformed):
            found.append(read_answer(bytes(line)))
    return found


class StopLines:
    """Requests stops without the transport.

    Args:
        settings: of the client; they say where others are.
        own: returns the client's own places, which are left out.
    """

    def __init__(self, settings: Settings, own: Callable[[], Collection[str]] = tuple) -> None:
        self._settings = settings
        self._own = own

    def estop(self, estop_id: str, reason: str, limit_s: float) -> LineCall[EstopReport]:
        """Begins to stop everything, as the e-stop with that id; does not wait."""
        relays, requests = _RELAYS, list[tuple[Place, StopRequest]]()
        for place in self._places():
            relays -= place.path is not None
            beyond = place.path is None or relays >= 0
            requests.append((place, self._request("estop", limit_s, reason, id=estop_id, pass_on=beyond)))

        def report_of(answer: StopAnswer) -> EstopReport | None:
            return None if answer.estop is None else as_seen_here(answer.estop)

        return LineCall(requests, limit_s, report_of, lambda reports: all_of(estop_id, reports))

    def stop(self, group: str, reason: str, limit_s: float) -> LineCall[StopReport]:
        """Begins to stop a whole group; does not wait."""
        request = self._request("stop", limit_s, reason, group=group)
        requests = [(place, request) for place in self._places()]
        return LineCall(requests, limit_s, lambda answer: answer.stop, lambda reports: merge_reports(group, reports))

    def without_line(self) -> dict[str, bool]:
        """The endpoints of ``Settings.connect`` that have no stop line, and whether each accepts a connection."""
        lines = {place.name for place in self._places()}
        others = [endpoint for endpoint in self._settings.connect if endpoint not in lines]
        with ThreadPoolExecutor(max(1, len(others)), "trade-stop-look") as pool:
            return dict(zip(others, pool.map(accepts, others), strict=True))

    def _request(self, ask: str, limit_s: float, reason: str, **more: object) -> StopRequest:
        by = f"{self._settings.identity}/{self._settings.container}"
        shortened = reason[:LONGEST_REASON]  # no stop is refused for its reason
        return StopRequest(v=VERSION, ask=ask, by=by, limit_s=limit_s, reason=shortened, **more)  # type: ignore[arg-type]

    def _places(self) -> list[Place]:
        own = self._own()
        return [place for place in places(self._settings) if place.name not in own]
