"""A dialogue with a system: a sentence in, a sentence out."""

from collections.abc import Mapping
from typing import Any, Final

import msgspec
from msgspec import Struct

from trade import Container
from trade_gateway._usage import find
from trade_gateway.language._lexicon import Lexicon, NotUnderstood, Phrase
from trade_gateway.language._questions import QUESTIONS, Memory, Unknown

__all__ = ["Reply", "Talk"]

_WAIT_S: Final = 1.0
_NUMBERS: Final = ("number", "other_number")


class Reply(Struct, frozen=True):
    """The reply to a sentence."""

    text: str
    means: str
    """The question or service behind the sentence."""
    data: Any
    """The result, for programs."""


class Talk:
    """Understands sentences by a lexicon, and executes them as a given container.

    Args:
        container: provides rights and session: its motion ends with it.
        lexicon: the known sentences.
        memory: the services of the last look, for changes.
    """

    def __init__(self, container: Container, lexicon: Lexicon, memory: Memory) -> None:
        self._container = container
        self._lexicon = lexicon
        self._memory = memory

    def say(self, sentence: str, *, orders: bool = True) -> Reply:
        """Executes a sentence.

        Args:
            sentence: in the phrases of the lexicon.
            orders: whether it may call services; otherwise only questions are answered.

        Raises:
            NotUnderstood: it matches no phrase, or names something that does not exist.
            TradeError: the call failed.
        """
        phrase, gaps = self._lexicon.hear(sentence)
        if not orders:
            _require_question(sentence, phrase)
        if phrase.call:
            return self._call(phrase, gaps)
        try:
            answer = QUESTIONS[phrase.ask].ask(self._container, self._memory, gaps)
        except Unknown as unknown:
            raise NotUnderstood(where=repr(sentence), problem=str(unknown)) from None
        template = phrase.say
        if answer.count == 0 and phrase.none:
            template = phrase.none
        elif answer.count == 1 and phrase.one:
            template = phrase.one
        return Reply(template.format(**{**gaps, **answer.fields}), phrase.ask, answer.data)

    def _call(self, phrase: Phrase, gaps: Mapping[str, str]) -> Reply:
        service = find(self._container, phrase.call, None, _WAIT_S)
        if isinstance(phrase.args, dict):
            result = service(**{name: _filled(value, gaps) for name, value in phrase.args.items()})
        else:
            result = service(*(_filled(value, gaps) for value in phrase.args))
        said = msgspec.json.encode(result).decode()
        return Reply(phrase.say.format(**{**gaps, "result": said}), phrase.call, result)


def _require_question(sentence: str, phrase: Phrase) -> None:
    if phrase.call:
        problem = f"this is an order, to call {phrase.call}. Only questions are answered here. Call the service itself"
        raise NotUnderstood(where=repr(sentence), problem=problem)
    if QUESTIONS[phrase.ask].is_order:
        problem = (
            "this is an order, and only questions are answered here. Nothing was stopped. "
            f"Call `{phrase.ask}` to stop the whole system, or `stop` to stop a group"
        )
        raise NotUnderstood(where=repr(sentence), problem=problem)


def _filled(value: Any, gaps: Mapping[str, str]) -> Any:
    """Fills the gaps of an argument: a number if the gap is all of it, else text."""
    if isinstance(value, list):
        return [_filled(one, gaps) for one in value]  # pyright: ignore[reportUnknownVariableType]
    if not isinstance(value, str):
        return value
    for gap in _NUMBERS:
        if value == f"{{{gap}}}":
            return float(gaps[gap])
    return value.format(**gaps)
