"""Rules that configure a running system, from a TOML file: on this occasion, if this holds, call these services."""

from trade._protocol.schema_types import publish
from trade.rules._engine import GROUP, Rehearsal, RuleInfo, Rules, rehearse
from trade.rules._file import Condition, Occasion, Rule, Selection, Step, read_rules
from trade.rules._steps import Did, Firing

__all__ = [
    "GROUP",
    "Condition",
    "Did",
    "Firing",
    "Occasion",
    "Rehearsal",
    "Rule",
    "RuleInfo",
    "Rules",
    "Selection",
    "Step",
    "read_rules",
    "rehearse",
]

publish(__name__, Did, Firing, RuleInfo)
