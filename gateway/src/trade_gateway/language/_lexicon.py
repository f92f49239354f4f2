"""The lexicon: sentences with gaps, the question or call of each, and its answer. It is checked as a whole."""

import re
import string
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta, Struct

from trade._toml import read_toml_text
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.language._questions import QUESTIONS

__all__ = ["Heard", "Lexicon", "NotUnderstood", "Phrase", "read_lexicon"]

_ATOM: Final = re.compile(r"\{(?P<gap>[a-z_]+)\}|(?P<mark>[()\[\]|])|(?P<word>[^\s{}()\[\]|]+)|(?P<space>\s+)")
_MARKS: Final = {"(": "(?:", ")": ")", "[": "(?:", "]": ")?", "|": "|"}
_NUMBERS: Final = ("number", "other_number")
_NUMBER: Final = r"[-+]?\d+(?:\.\d+)?"
_ANY: Final = r"\S(?:.*?\S)??"
_NOISE: Final = re.compile(r"[?!.,;]+(?=\s|$)")

_Text = Annotated[str, Meta(min_length=1)]


class NotUnderstood(UsageError):
    """A sentence matches no phrase, or names something that does not exist."""


class Phrase(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sentences with the same meaning, and that meaning."""

    hear: Annotated[list[_Text], Meta(min_length=1)]
    """``who (has|holds) [the] {group}``: alternatives, an optional word, a gap."""
    ask: str = ""
    """A question, or"""
    call: str = ""
    """a service: ``rosie.head.move_to``."""
    args: list[Any] | dict[str, Any] = []
    """Arguments of the call; ``"{number}"`` is the content of that gap."""
    say: _Text
    """The answer; ``{names}`` and the like are parts of the result."""
    one: str = ""
    """The answer for exactly one."""
    none: str = ""
    """The answer for none."""


class Heard(NamedTuple):
    """The phrase that matches a sentence, and its gaps."""

    phrase: Phrase
    gaps: Mapping[str, str]


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    phrase: list[Phrase] = []


class Lexicon:
    """Phrases in the order in which they are tried."""

    def __init__(self, phrases: Sequence[Phrase]) -> None:
        self._patterns = [(_pattern(text), phrase) for phrase in phrases for text in phrase.hear]
        self.sentences: Final = [text for phrase in phrases for text in phrase.hear[:1]]
        """One sentence of each phrase, for help."""

    def hear(self, sentence: str) -> Heard:
        """Finds the phrase of a sentence. Raises NotUnderstood."""
        heard = " ".join(_NOISE.sub("", sentence).split())
        for pattern, phrase in self._patterns:
            if found := pattern.fullmatch(heard):
                return Heard(phrase, {gap: text for gap, text in found.groupdict().items() if text is not None})
        problem = f"I do not understand that. I do understand, for example: {'; '.join(self.sentences[:6])}"
        raise NotUnderstood(where=repr(sentence), problem=problem)


def read_lexicon(path: Path | None = None) -> Lexicon:
    """Reads the built-in lexicon; the phrases of a file have priority over it.

    Raises:
        ConfigurationError: names the file, the phrase, and what is valid.
    """
    own = files("trade_gateway.language").joinpath("lexicon.toml").read_text(encoding="utf-8")
    read = list(_phrases(own, "lexicon.toml"))
    if path is not None:
        try:
            read[:0] = _phrases(path.read_text(encoding="utf-8"), str(path))
        except OSError as bad:
            raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None
        except UnicodeDecodeError as bad:
            raise ConfigurationError(where=str(path), problem=f"is not UTF-8: {bad}") from None
    return Lexicon(read)


def _phrases(text: str, where: str) -> Iterator[Phrase]:
    try:
        raw = read_toml_text(text)
        file = msgspec.convert(raw, _File)
    except ValueError as bad:  # not TOML, or another structure
        raise ConfigurationError(where=where, problem=str(bad)) from None
    for phrase in file.phrase:
        _check(phrase, f"{where}: {phrase.hear[0]!r}")
        yield phrase


def _check(phrase: Phrase, where: str) -> None:
    """Raises ConfigurationError: its question does not exist, or it uses unknown gaps or fields."""
    if bool(phrase.ask) == bool(phrase.call):
        raise ConfigurationError(where=where, problem="needs either ask or call")
    if phrase.ask and phrase.ask not in QUESTIONS:
        problem = f"there is no question {phrase.ask!r}; there is {', '.join(QUESTIONS)}"
        raise ConfigurationError(where=where, problem=problem)
    if phrase.call and "." not in phrase.call:
        problem = f"{phrase.call!r} is not a service. Write GROUP.NAME, such as rosie.head.move_to"
        raise ConfigurationError(where=where, problem=problem)
    if phrase.args and not phrase.call:
        raise ConfigurationError(where=where, problem="args are only for call. Remove them")
    gaps = [_gaps(text, where) for text in phrase.hear]
    known = QUESTIONS[phrase.ask] if phrase.ask else None
    if known is not None and (strange := set[str]().union(*gaps) - set(known.gaps)):
        problem = f"question {phrase.ask!r} has no use for {_listed(strange)}; it takes {_listed(known.gaps) or 'none'}"
        raise ConfigurationError(where=where, problem=problem)
    fields = set(known.fields) if known is not None else {"result"}
    always = set[str].intersection(*gaps)
    for template in (phrase.say, phrase.one, phrase.none):
        if strange := _fields(template, where) - fields - always:
            problem = f"{_listed(strange)} is not part of the result; there is {_listed(fields | always)}"
            raise ConfigurationError(where=where, problem=problem)


def _gaps(text: str, where: str) -> set[str]:
    try:
        return set(_pattern(text).groupindex)
    except (re.error, ValueError) as bad:
        raise ConfigurationError(where=where, problem=f"{text!r} is not a sentence with gaps: {bad}") from None


def _fields(template: str, where: str) -> set[str]:
    try:
        return {field for _, field, _, _ in string.Formatter().parse(template) if field is not None}
    except ValueError as bad:
        raise ConfigurationError(where=where, problem=f"{template!r}: {bad}") from None


def _listed(names: Sequence[str] | set[str] | frozenset[str]) -> str:
    return ", ".join(f"{{{name}}}" for name in sorted(names))


def _pattern(text: str) -> re.Pattern[str]:
    """Compiles a sentence. Words match as a whole; spaces around an omitted word are optional."""
    made, at = "", 0
    for atom in _ATOM.finditer(text):
        if atom.start() != at:
            break
        at = atom.end()
        if gap := atom["gap"]:
            made += f"(?P<{gap}>{_NUMBER if gap in _NUMBERS else _ANY})(?!\\w) ?"
        elif mark := atom["mark"]:
            made += _MARKS[mark]
        elif word := atom["word"]:
            made += f"{re.escape(word)}(?!\\w) ?"
    if at != len(text):
        raise ValueError(f"stops making sense at {text[at:]!r}")
    return re.compile(made, re.IGNORECASE)
