"""Sentences as questions and orders, and their answers as sentences, by a lexicon of phrases."""

from trade_gateway.language._dialogue import Dialogue, Reply
from trade_gateway.language._lexicon import Lexicon, NotUnderstood, read_lexicon
from trade_gateway.language._memory import Memory
from trade_gateway.language._model import Model

__all__ = ["Dialogue", "Lexicon", "Memory", "Model", "NotUnderstood", "Reply", "read_lexicon"]
