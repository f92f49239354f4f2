"""Access policies for programs that inspect them, or that open sessions of the transport themselves.

Containers read their own: see `trade.Settings.policy` and `trade.Container.load_policy`.
"""

from trade._security.authorizer import decide_call
from trade._security.certificates import Certificate
from trade._security.network_crossings import Crossing, crossings
from trade._security.policy import EVERYTHING, VERBS, Decision, Policy, Role, different
from trade._security.policy_file import policy_files, read_policy
from trade._security.zenoh_acl import acl

__all__ = [
    "EVERYTHING",
    "VERBS",
    "Certificate",
    "Crossing",
    "Decision",
    "Policy",
    "Role",
    "acl",
    "crossings",
    "decide_call",
    "different",
    "policy_files",
    "read_policy",
]
