"""Rules that configure a running system, from a TOML file: when an event occurs and a condition holds, make calls."""

from trade.protocol.schema_types import publish as _publish
from trade.rules._engine import GROUP, DryRun, RuleInfo, Rules, rehearse
from trade.rules._file import Condition, Rule, RuleEvent, Selection, Step, read_rules
from trade.rules._steps import Firing, StepResult

__all__ = [
    "GROUP",
    "Condition",
    "DryRun",
    "Firing",
    "Rule",
    "RuleEvent",
    "RuleInfo",
    "Rules",
    "Selection",
    "Step",
    "StepResult",
    "read_rules",
    "rehearse",
]

_publish(__name__, StepResult, Firing, RuleInfo, DryRun)
