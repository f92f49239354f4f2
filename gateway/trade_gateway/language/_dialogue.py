"""A dialogue with a system: a sentence in, a sentence out."""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import msgspec
from msgspec import Struct

from trade import Container
from trade.errors import LockLost
from trade_gateway._usage import find
from trade_gateway.language._catalogue import REQUESTS
from trade_gateway.language._lexicon import NUMBERS, Lexicon, NotUnderstood, Phrase, PhraseMatch
from trade_gateway.language._memory import Memory
from trade_gateway.language._model import Model
from trade_gateway.language._orders import permitted
from trade_gateway.language._requests import Ambiguous, Answer, Gaps, Plan, Requester, Unknown

_WAIT_S: Final = 1.0
_CONFIRM_S: Final = 60.0
"""How long a yes counts, in seconds."""
_HARMLESS: Final = ("note", "read", "stop")
"""Effects of services that need no confirmation."""
_REPEATABLE: Final = ("group", "place", "container", "host", "service", "goal")
"""Gaps that "and the right one?" can replace, the first of them that the last question has."""
_IT: Final = ("it", "them", "him", "her")


class Reply(Struct, frozen=True):
    """The reply to a sentence."""

    text: str
    means: str
    """The request or service behind the sentence."""
    data: Any
    """The result, for programs; of an order that waits, what it would do."""
    waits: Literal["", "yes", "choice"] = ""
    """What it waits for before anything is done."""


class _Pending(NamedTuple):
    heard: PhraseMatch
    plan: Plan
    asked_at: float


class _Choice(NamedTuple):
    heard: PhraseMatch
    which: Ambiguous
    by_model: bool


class Dialogue:
    """Understands sentences by a lexicon, and executes them as a given container.

    Args:
        container: provides rights and session: its motion and its locks end with it.
        lexicon: the known sentences.
        memory: the services of the last look, for changes.
        audit: the folder of this host's audit records, for reasons of stops.
        model: maps sentences that the lexicon does not know onto the same requests.
        show: called with what the model proposes, before it runs.
        keeps: whether the dialogue lasts beyond a sentence, so that it can keep a lock.
    """

    def __init__(
        self,
        container: Container,
        lexicon: Lexicon,
        memory: Memory,
        *,
        audit: Path | None = None,
        model: Model | None = None,
        show: Callable[[str], None] = lambda _: None,
        keeps: bool = False,
    ) -> None:
        self._asker = Requester(container, memory, audit, keeps)
        self._container = container
        self._lexicon = lexicon
        self._model = model
        self._show = show
        self._last: PhraseMatch | None = None
        self._gaps: Gaps = {}
        self._pending: _Pending | None = None
        self._choice: _Choice | None = None

    def say(self, sentence: str, *, orders: bool = True, confirmed: bool = False) -> Reply:
        """Answers a question, or executes an order that needs no confirmation or has it.

        For any other order it only says what it would do. A later "yes" confirms it.

        Args:
            sentence: in the phrases of the lexicon.
            orders: whether it may act; otherwise only questions are answered.
            confirmed: whether an order in this sentence is confirmed already.

        Raises:
            NotUnderstood: it matches no phrase, or names something that does not exist.
            TradeError: the call failed.
        """
        choice, self._choice = self._choice, None
        pending, self._pending = self._pending, None
        heard, by_model = self._heard(sentence, choice)
        if not orders:
            _require_question(sentence, heard.phrase)
        if heard.phrase.ask in ("yes", "no"):
            return self._decided(sentence, heard.phrase.ask, pending)
        try:
            heard = self._repeated(heard) if heard.phrase.ask == "again" else self._referred(heard)
            found = self._found(heard)
        except Unknown as unknown:
            raise NotUnderstood(where=repr(sentence), problem=str(unknown)) from None
        except Ambiguous as which:
            self._choice = _Choice(heard, which, by_model)
            text = str(which)
            return Reply(text[:1].upper() + text[1:], heard.phrase.means, list(which.choices), waits="choice")
        if isinstance(found, Answer):
            self._last, self._gaps = heard, heard.gaps
            return _reply(heard, found)
        if (found.confirm or by_model) and not confirmed:
            self._pending = _Pending(heard, found, time.monotonic())
            return Reply(f"Shall I {found.shall}? (yes/no)", heard.phrase.means, found.shall, waits="yes")
        return self._done(heard, found)

    def close(self) -> None:
        """Releases the locks that the dialogue holds. Idempotent."""
        while self._asker.locks:
            self._asker.locks.pop().release()

    # --- what a sentence asks for

    def _heard(self, sentence: str, choice: _Choice | None) -> tuple[PhraseMatch, bool]:
        """The meaning of a sentence, and whether it is the proposal of a model."""
        try:
            return self._lexicon.hear(sentence), False
        except NotUnderstood:
            if choice is not None and (heard := _chosen(sentence, choice)) is not None:
                return heard, choice.by_model
            if self._model is None:
                raise
        heard = self._model.propose(sentence, self._lexicon, self._container)
        self._show(_shown(heard))
        return heard, True

    def _found(self, sentence: PhraseMatch) -> Answer | Plan:
        phrase, gaps = sentence
        return self._planned_call(phrase, gaps) if phrase.call else REQUESTS[phrase.ask].ask(self._asker, gaps)

    def _planned_call(self, phrase: Phrase, gaps: Gaps) -> Plan:
        service = permitted(self._container, find(self._container, phrase.call, None, _WAIT_S))
        args = () if isinstance(phrase.args, dict) else tuple(_filled(value, gaps) for value in phrase.args)
        named = phrase.args if isinstance(phrase.args, dict) else {}
        bound = service.bind(*args, **{name: _filled(value, gaps) for name, value in named.items()})

        def do() -> Answer:
            result = bound()
            return Answer(2, {"result": msgspec.json.encode(result).decode()}, result)

        shown = [_json(value) for value in bound.args] + [f"{name}={_json(one)}" for name, one in bound.kwargs.items()]
        shall, stops = f"call {service.label}({', '.join(shown)})", service.effect == "stop"
        return Plan(shall, do, confirm=service.effect not in _HARMLESS, stops=stops)

    def _repeated(self, sentence: PhraseMatch) -> PhraseMatch:
        """The last question, with another name. Raises Unknown."""
        if self._last is None:
            raise Unknown("that repeats a question, and none was asked just before. Say the whole sentence")
        phrase, gaps = self._last
        gap = next((gap for gap in _REPEATABLE if gap in gaps), "")
        if not gap:
            raise Unknown(f"that refers to the last question, {phrase.means!r}, which is about no name")
        name = sentence.gaps["name"]
        words = name.split()
        if words[-1].lower() == "one" and len(words) > 1:
            name = " ".join([*words[:-1], *gaps[gap].split()[-1:]])
        return PhraseMatch(phrase, self._lexicon.named({**gaps, gap: name}))

    def _referred(self, sentence: PhraseMatch) -> PhraseMatch:
        """The sentence, with the name of the last sentence in place of "it"."""
        gaps = {gap: self._gaps.get(gap, text) if text.lower() in _IT else text for gap, text in sentence.gaps.items()}
        return PhraseMatch(sentence.phrase, gaps)

    # --- doing it

    def _decided(self, sentence: str, word: str, pending: _Pending | None) -> Reply:
        if pending is None:
            problem = "I have asked nothing that this would answer. `stop` stops everything"
            raise NotUnderstood(where=repr(sentence), problem=problem)
        means = pending.heard.phrase.means
        if word == "no":
            return Reply("Nothing was done.", means, None)
        if time.monotonic() - pending.asked_at > _CONFIRM_S:
            problem = f"I asked more than {_CONFIRM_S:.0f} s ago, so nothing was done. Say the order again"
            raise NotUnderstood(where=repr(sentence), problem=problem)
        return self._done(pending.heard, pending.plan)

    def _done(self, sentence: PhraseMatch, plan: Plan) -> Reply:
        """Executes an order, under the locks of the dialogue. Raises LockLost once for each of them that is lost."""
        self._last, self._gaps = None, sentence.gaps  # a follow-up repeats a question, and never an order
        try:
            with ExitStack() as held:
                for lock in () if plan.stops else list(self._asker.locks):
                    lock.check()
                    held.enter_context(lock.use())
                return _reply(sentence, plan.do())
        except LockLost:
            self._asker.locks[:] = [lock for lock in self._asker.locks if lock.held]
            raise


def _reply(sentence: PhraseMatch, answer: Answer) -> Reply:
    phrase = sentence.phrase
    template = phrase.say
    if answer.count == 0 and phrase.none:
        template = phrase.none
    elif answer.count == 1 and phrase.one:
        template = phrase.one
    return Reply(template.format(**{**sentence.gaps, **answer.fields}).strip(), phrase.means, answer.data)


def _chosen(sentence: str, choice: _Choice) -> PhraseMatch | None:
    """The ambiguous sentence with the meaning that this one chooses, if it chooses exactly one."""
    words = set(_words(sentence)) - {"the", "one", "i", "mean", "on", "in"}
    fit = [one for one in choice.which.choices if words and words <= set(_words(one))]
    exact = [one for one in fit if words == set(_words(one))]
    fit = exact if len(exact) == 1 else fit
    heard = choice.heard
    return PhraseMatch(heard.phrase, {**heard.gaps, choice.which.gap: fit[0]}) if len(fit) == 1 else None


def _words(text: str) -> list[str]:
    return "".join(letter if letter.isalnum() else " " for letter in text.lower()).split()


def _shown(sentence: PhraseMatch) -> str:
    """A request as it is shown: ``migrate(group='planner', place='base')``."""
    return f"{sentence.phrase.means}({', '.join(f'{gap}={text!r}' for gap, text in sentence.gaps.items())})"


def _require_question(sentence: str, phrase: Phrase) -> None:
    if phrase.call:
        problem = f"this is an order, to call {phrase.call}. Only questions are answered here. Call the service itself"
        raise NotUnderstood(where=repr(sentence), problem=problem)
    if phrase.ask in ("estop", "stop"):
        problem = (
            "this is an order, and only questions are answered here. Nothing was stopped. "
            "Call `estop` to stop the whole system, or `stop` to stop a group"
        )
        raise NotUnderstood(where=repr(sentence), problem=problem)
    if REQUESTS[phrase.ask].is_order:
        problem = f"this is an order ({phrase.ask}), and only questions are answered here. Nothing was done"
        raise NotUnderstood(where=repr(sentence), problem=problem)


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def _filled(value: Any, gaps: Mapping[str, str]) -> Any:
    """Fills the gaps of an argument: a number if the gap is all of it, else text."""
    if isinstance(value, list):
        return [_filled(one, gaps) for one in value]  # pyright: ignore[reportUnknownVariableType]
    if not isinstance(value, str):
        return value
    for gap in NUMBERS:
        if value == f"{{{gap}}}":
            return float(gaps[gap])
    return value.format(**gaps)
