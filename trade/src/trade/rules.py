"""Rules that configure a running system, from a TOML file: on this occasion, if this holds, call these services."""

from trade._rule_steps import Did, Firing
from trade._rules import GROUP, Rehearsal, RuleInfo, Rules, rehearse
from trade._rules_file import Condition, Occasion, Rule, Selection, Step, read_rules

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
