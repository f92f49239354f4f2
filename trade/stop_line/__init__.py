"""The stop line: stops and e-stops that need neither the transport nor a link of it (S07).

Each container listens on it; any client that may reach the container may ask it to stop a group or everything.
docs/wire-protocol.md, "The stop line", describes its messages.
"""

from trade.stop_line.api import StopApi
from trade.stop_line.client import LineCall, StopLines
from trade.stop_line.elsewhere import elsewhere
from trade.stop_line.group_stop import GroupStop, GroupStopServices, StopReport, merge_reports, session_for
from trade.stop_line.relayed_estop import RelayedEstop
from trade.stop_line.service import StopLineService

__all__ = [
    "GroupStop",
    "GroupStopServices",
    "LineCall",
    "RelayedEstop",
    "StopApi",
    "StopLineService",
    "StopLines",
    "StopReport",
    "elsewhere",
    "merge_reports",
    "session_for",
]
