"""Stops of a group: on the links of this container, on the stop line, and through other containers."""

import time
from collections.abc import Sequence

from trade._calls.client import CallClient
from trade._estop.controller import LIMIT_S, check_limit
from trade._registry.constraints import where
from trade.stop_line.client import StopLines
from trade.stop_line.group_stop import GroupStop, StopReport, merge_reports, session_for


class StopApi:
    """Stops of one container, for itself and for clients on its stop line."""

    def __init__(self, client: CallClient, stop_lines: StopLines) -> None:
        self._client = client
        self._stop_lines = stop_lines

    def stop(self, group: str, reason: str = "", *, limit_s: float = LIMIT_S) -> StopReport:
        """Calls all stop services of a group at once, and waits until what they stop is at rest (S07).

        It needs no lock and no existing link: it also asks containers on the stop line, and each container that it sees
        stops what only that one sees. A service that any of them stopped is stopped. Read the report:
        `StopReport.complete`. This is software, not safety-rated.

        Args:
            group: such as ``rosie.left``, with all groups beneath it.
            reason: why, for the record.
            limit_s: how long to try, in seconds; also if nothing is found, and a container may be missing.

        Raises:
            ConfigurationError: the group or the limit is not valid.
        """
        check_limit(limit_s, "stop")
        until, constraint, registry = time.monotonic() + limit_s, where(group=group), self._client.registry
        line_call = self._stop_lines.stop(group, reason, limit_s)
        group_stop = GroupStop(self._client, group, reason)

        def ready() -> bool:
            found = bool(registry.select(constraint)) or bool(group_stop.report().stopped)
            return found or (line_call.is_done() and (bool(line_call.report().stopped) or self._sees_all()))

        report = group_stop.wait(until, ready)
        return merge_reports(group, [report, line_call.report() if report.complete else line_call.wait()])

    def stop_for(self, client: str, group: str, limit_s: float, known: Sequence[str] = ()) -> StopReport:
        """Calls the stop services of a group that are known here, in a session of the client that asks.

        Args:
            who: the client.
            group: what to stop, with all groups beneath it.
            limit_s: how long to wait, in seconds.
            known: the keys of services that the client stops itself.
        """
        until = time.monotonic() + limit_s
        with session_for(self._client.address, client).use():
            return GroupStop(self._client, group, None, known).wait(until, lambda: True)

    def _sees_all(self) -> bool:
        """Whether no container is known to be missing: each has listed its services, and each dialled one is linked."""
        own, dialer = self._client.address, self._client.dialer
        listed = all(state.heard.complete for state in self._client.registry.containers() if state.address != own)
        return listed and not (dialer is not None and dialer.unlinked())
