"""``trade drill``: fails a moving simulated twin's processes and connections, and measures the time until it stops."""

from trade_checks.drill._report import Report, SceneReport, Stop, as_data, page
from trade_checks.drill._runner import play
from trade_checks.drill._scenes import SCENES, Scene
from trade_checks.drill._targets import Target, targets_of
from trade_checks.drill._testbed import standing

__all__ = [
    "SCENES",
    "Report",
    "Scene",
    "SceneReport",
    "Stop",
    "Target",
    "as_data",
    "page",
    "play",
    "standing",
    "targets_of",
]
