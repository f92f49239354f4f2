"""The lexicon: sentences with gaps, the request or call of each, and its answer. It is checked as a whole."""

import re
import string
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta, Struct

from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade.toml_files import read_toml_text
from trade_gateway._usage import UsageError
from trade_gateway.language._catalogue import DIALOGUE, REQUESTS
from trade_gateway.language._requests import Gaps

_ATOM: Final = re.compile(r"\{(?P<gap>[a-z_]+)\}|(?P<mark>[()\[\]|])|(?P<word>[^\s{}()\[\]|]+)|(?P<space>\s+)")
_MARKS: Final = {"(": "(?:", ")": ")", "[": "(?:", "]": ")?", "|": "|"}
NUMBERS: Final = ("number", "other_number")
"""Gaps that hold a number."""
_NUMBER: Final = r"[-+]?\d+(?:\.\d+)?"
_ANY: Final = r"\S(?:.*?\S)??"
_NAMES: Final = ("container", "group", "host", "kind", "name", "place", "service", "source")
"""Gaps that hold a name: a few words, none of which joins sentences or belongs to one."""
_IN_NO_NAME: Final = (
    "a|about|after|again|all|am|an|and|are|as|at|because|before|but|by|can|could|did|do|does|else|except|for|from|had|has"
    "|have|how|i|if|in|instead|into|is|may|must|never|no|none|nor|not|nothing|now|of|off|on|onto|or|over|please"
    "|nobody"
    "|shall|should|so|still|than|then|there|to|too|unless|until|was|we|were|what|when|where|whether|which|while|who|why|will|with"
    "|without|would|yes|you|(?:i|it|let|that|what|who|you)'\\w+|\\w+n't"
)
_NAME_WORD: Final = rf"(?!(?:{_IN_NO_NAME})(?!\S))\S+"
_NAME: Final = rf"{_NAME_WORD}(?: {_NAME_WORD}){{0,3}}?"
_ENDPOINT: Final = r"(?=\S*[\w\]])[\w./:\[\]%#?=&-]+"
_NOISE: Final = re.compile(r"[?!.,;]+(?=\s|$)")
_ARTICLE: Final = re.compile(r"(?:(?:the|my|our|this|that) )+(?=\S)", re.IGNORECASE)
_POLITE: Final = re.compile(
    r"(?:(?:and|hello|hey|hi|just|kindly|now|ok|okay|please|so|then|well"
    r"|(?:can|could|will|would) you(?: please)?|i(?: would|'d)? (?:like|want) you to"
    r"|(?:(?:can|could) you )?tell me|do you know|i want to know) )+",
    re.IGNORECASE,
)
_POLITE_END: Final = re.compile(
    r"(?: (?:please|now|right now|at once|immediately|thanks|thank you|then|right away))+\Z",
    re.IGNORECASE,
)

_ASKING: Final = re.compile(
    r"(?:(?:who|whose|what|where|when|why|how|which|is|are|was|were|does|did|has|have|am|may|should|shall)(?:'\w+)?(?!\S)"
    r"|do (?!an? |it|not))",
    re.IGNORECASE,
)
_Text = Annotated[str, Meta(min_length=1)]


class NotUnderstood(UsageError):
    """A sentence matches no phrase, or names something that does not exist."""


class Phrase(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sentences with the same meaning, and that meaning."""

    hear: Annotated[list[_Text], Meta(min_length=1)]
    """``who (has|holds) [the] {group}``: alternatives, an optional word, a gap."""
    ask: str = ""
    """A question or an order, or"""
    call: str = ""
    """a service: ``rosie.head.move_to``."""
    args: list[Any] | dict[str, Any] = []
    """Arguments of the call; ``"{number}"`` is the content of that gap."""
    say: str = ""
    """The answer; ``{names}`` and the like are parts of the result."""
    one: str = ""
    """The answer for exactly one."""
    none: str = ""
    """The answer for none."""

    @property
    def means(self) -> str:
        """The request or service."""
        return self.ask or self.call

    @property
    def is_order(self) -> bool:
        """Whether it may act on the system."""
        return bool(self.call) or REQUESTS[self.ask].is_order


class PhraseMatch(NamedTuple):
    """The phrase that matches a sentence, and its gaps."""

    phrase: Phrase
    gaps: Gaps


class _Pattern(NamedTuple):
    regex: re.Pattern[str]
    sure: frozenset[str]
    """The gaps that are never left out."""
    phrase: Phrase


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    phrase: list[Phrase] = []
    name: dict[str, _Text] = {}
    """What some words mean wherever a name is expected: ``eyes = "rosie.vision"``."""


class Lexicon:
    """Phrases in the order in which they are tried."""

    def __init__(self, phrases: Sequence[Phrase], names: Mapping[str, str] | None = None) -> None:
        self._patterns = [_Pattern(_pattern(text), _sure(text), one) for one in phrases for text in one.hear]
        self._names = {name.lower(): meant for name, meant in (names or {}).items()}
        self.phrases: Final = tuple(phrases)
        """Its phrases."""
        shown = sorted((phrase for phrase in phrases if phrase.ask not in DIALOGUE), key=lambda one: one.is_order)
        self.sentences: Final = [phrase.hear[0] for phrase in shown]
        """One sentence of each phrase, for help: the questions, then the orders."""

    def hear(self, sentence: str) -> PhraseMatch:
        """Finds the phrase of a sentence. Raises NotUnderstood."""
        for heard in _forms(_plain(sentence)):
            for pattern, _, phrase in self._patterns:
                if found := pattern.fullmatch(heard):
                    gaps = {gap: text for gap, text in found.groupdict().items() if text is not None}
                    return PhraseMatch(phrase, self.named(gaps))
        problem = f"I do not understand that. I do understand, for example: {'; '.join(self.sentences[:6])}"
        raise NotUnderstood(where=repr(sentence), problem=problem)

    def named(self, gaps: Gaps) -> dict[str, str]:
        """The gaps without articles, and with the names that the lexicon's files define."""
        plain = {gap: _ARTICLE.sub("", text, count=1) if gap in _NAMES else text for gap, text in gaps.items()}
        return {gap: self._names.get(text.lower(), text) if gap in _NAMES else text for gap, text in plain.items()}

    def gaps_of(self, phrase: Phrase) -> tuple[list[str], list[str]]:
        """All gaps of a phrase's sentences, and those that none of them leaves out."""
        own = [one for one in self._patterns if one.phrase is phrase]
        every = {gap for one in own for gap in one.regex.groupindex}
        return sorted(every), sorted(frozenset[str].intersection(*(one.sure for one in own)))

    def phrase(self, means: str, gaps: Gaps) -> Phrase | None:
        """The first phrase with that meaning that takes exactly these gaps, if their texts fit and there is one."""
        if not all(re.fullmatch(_of_gap(gap), text, re.IGNORECASE) for gap, text in gaps.items()):
            return None
        fit = [one for one in self._patterns if one.phrase.means == means]
        return next((one.phrase for one in fit if one.sure <= set(gaps) <= set(one.regex.groupindex)), None)


def is_question(sentence: str) -> bool:
    """Whether a sentence asks; "could you ...?" does not."""
    plain = _plain(sentence)
    form = next(_forms(plain))
    return bool(_ASKING.match(form)) or (sentence.rstrip().endswith("?") and len(form) == len(plain))


def _plain(sentence: str) -> str:
    """A sentence without punctuation and further spaces."""
    return " ".join(_NOISE.sub("", sentence.replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")).split())


def _forms(sentence: str) -> Iterator[str]:
    """A sentence without its polite words, and as it is."""
    start = _POLITE.match(sentence)
    plain = sentence[start.end() :] if start is not None else sentence
    if end := _POLITE_END.search(plain):
        plain = plain[: end.start()]
    yield plain
    if plain != sentence:
        yield sentence


def read_lexicon(path: Path | None = None) -> Lexicon:
    """Reads the built-in lexicon; the phrases of a file have priority over it.

    Raises:
        ConfigurationError: names the file, the phrase, and what is valid.
    """
    own = files("trade_gateway.language").joinpath("lexicon.toml").read_text(encoding="utf-8")
    phrases, names = _read(own, "lexicon.toml")
    if path is not None:
        try:
            further, names = _read(read_text(path), str(path))
        except OSError as bad:
            raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None
        except UnicodeDecodeError as bad:
            raise ConfigurationError(where=str(path), problem=f"is not UTF-8: {bad}") from None
        phrases[:0] = further
    return Lexicon(phrases, names)


def _read(text: str, where: str) -> tuple[list[Phrase], dict[str, str]]:
    try:
        raw = read_toml_text(text)
        file = msgspec.convert(raw, _File)
    except ValueError as bad:  # not TOML, or another structure
        raise ConfigurationError(where=where, problem=str(bad)) from None
    for phrase in file.phrase:
        _check(phrase, f"{where}: {phrase.hear[0]!r}")
    return file.phrase, file.name


def _check(phrase: Phrase, where: str) -> None:
    """Raises ConfigurationError: its request does not exist, or it uses unknown gaps or fields."""
    if bool(phrase.ask) == bool(phrase.call):
        raise ConfigurationError(where=where, problem="needs either ask or call")
    if phrase.ask and phrase.ask not in REQUESTS:
        problem = f"there is no question or order {phrase.ask!r}; there is {', '.join(REQUESTS)}"
        raise ConfigurationError(where=where, problem=problem)
    if phrase.call and "." not in phrase.call:
        problem = f"{phrase.call!r} is not a service. Write GROUP.NAME, such as rosie.head.move_to"
        raise ConfigurationError(where=where, problem=problem)
    if phrase.args and not phrase.call:
        raise ConfigurationError(where=where, problem="args are only for call. Remove them")
    gaps = [_gaps(text, where) for text in phrase.hear]
    known = REQUESTS[phrase.ask] if phrase.ask else None
    if known is not None and (strange := set[str]().union(*gaps) - set(known.gaps)):
        kind, takes = "order" if known.is_order else "question", _listed(known.gaps) or "none"
        problem = f"{kind} {phrase.ask!r} has no use for {_listed(strange)}; it takes {takes}"
        raise ConfigurationError(where=where, problem=problem)
    if phrase.ask in DIALOGUE:
        return  # what it repeats or confirms has its own answer
    if not phrase.say:
        raise ConfigurationError(where=where, problem="needs say, the answer")
    fields = set(known.fields) if known is not None else {"result"}
    always = frozenset[str].intersection(*map(_sure, phrase.hear))
    for template in (phrase.say, phrase.one, phrase.none):
        if strange := _fields(template, where) - fields - always:
            problem = f"{_listed(strange)} is not part of the result; there is {_listed(fields | always)}"
            raise ConfigurationError(where=where, problem=problem)


def _gaps(text: str, where: str) -> set[str]:
    try:
        return set(_pattern(text).groupindex)
    except (re.error, ValueError) as bad:
        raise ConfigurationError(where=where, problem=f"{text!r} is not a sentence with gaps: {bad}") from None


def _sure(text: str) -> frozenset[str]:
    """The gaps of a sentence that are neither optional nor in an alternative."""
    depth, found = 0, set[str]()
    for atom in _ATOM.finditer(text):
        if mark := atom["mark"]:
            depth += {"(": 1, "[": 1, ")": -1, "]": -1, "|": 0}[mark]
        elif atom["gap"] and not depth:
            found.add(atom["gap"])
    return frozenset(found)


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
            made += f"(?P<{gap}>{_of_gap(gap)})(?!\\w) ?"
        elif mark := atom["mark"]:
            made += _MARKS[mark]
        elif word := atom["word"]:
            made += f"{re.escape(word)}(?!\\w) ?"
    if at != len(text):
        raise ValueError(f"stops making sense at {text[at:]!r}")
    return re.compile(made, re.IGNORECASE)


def _of_gap(gap: str) -> str:
    if gap == "endpoint":
        return _ENDPOINT
    return _NUMBER if gap in NUMBERS else _NAME if gap in _NAMES else _ANY
