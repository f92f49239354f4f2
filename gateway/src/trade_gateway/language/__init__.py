"""Sentences as questions and calls, and their answers as sentences, by a lexicon of phrases."""

from trade_gateway.language._dialogue import Reply, Talk
from trade_gateway.language._lexicon import Lexicon, NotUnderstood, read_lexicon
from trade_gateway.language._questions import Memory

__all__ = ["Lexicon", "Memory", "NotUnderstood", "Reply", "Talk", "read_lexicon"]
