"""Words into calls, and answers into words: the lexicon says which sentences mean what."""

from trade_gateway.talk._lexicon import Lexicon, NotUnderstood, read_lexicon
from trade_gateway.talk._memory import Memory
from trade_gateway.talk._talk import Reply, Talk

__all__ = ["Lexicon", "Memory", "NotUnderstood", "Reply", "Talk", "read_lexicon"]
