"""Sentences as questions and orders, and their answers as sentences, by a lexicon of phrases."""

from trade_gateway.language._dialogue import Reply, Talk
from trade_gateway.language._lexicon import Lexicon, NotUnderstood, read_lexicon
from trade_gateway.language._memory import Memory
from trade_gateway.language._model import Model

__all__ = ["Lexicon", "Memory", "Model", "NotUnderstood", "Reply", "Talk", "read_lexicon"]
