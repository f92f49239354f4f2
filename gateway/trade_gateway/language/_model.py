"""A language model as a command: it maps free text onto the requests of the lexicon, and decides nothing."""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import IO, Any, Final

import msgspec
from msgspec import Struct

from trade import Container
from trade.errors import ConfigurationError
from trade_gateway.language._catalogue import DIALOGUE
from trade_gateway.language._lexicon import Lexicon, NotUnderstood, Phrase, PhraseMatch, is_question
from trade_gateway.language._names import others

_LIMIT_S: Final = 30.0
_LOOK_S: Final = 0.02
_END_S: Final = 5.0
_MOST_BYTES: Final = 64 << 10
_MOST_NAMES: Final = 200
_LEAST_SHARED: Final = 4
"""How many first letters two words share if they mean the same: discovery, discoverable."""
_WEAK: Final = re.compile(
    "again|because|down|everything|from|give|have|into|make|need|over|please|robot|start|switch|system|take|that|them|this"
    "|turn|want|whole|with|would"
)
"""Words that say nothing about what is asked for."""


class _Proposal(Struct, frozen=True, forbid_unknown_fields=True):
    request: str
    gaps: dict[str, str] = {}


class Model:
    """A command that gets a JSON request on its standard input, and prints one JSON object.

    The request has ``sentence``; ``requests``, each with its name, its gaps, examples, and whether it is an order; and
    ``names`` of what exists. The answer is ``{"request": "migrate", "gaps": {"group": "planner", "place": "base"}}``,
    or ``{"request": ""}`` if no request fits. The answer only counts if such a sentence could be typed.

    Args:
        command: the command, with its arguments.
        limit_s: how long it may take for one sentence, in seconds; it is then killed.
    """

    def __init__(self, command: str | Sequence[str], limit_s: float = _LIMIT_S) -> None:
        self._command = shlex.split(command) if isinstance(command, str) else list(command)
        self._limit_s = limit_s
        if not self._command:
            raise ConfigurationError(where="--model", problem="names no command")

    def propose(self, sentence: str, lexicon: Lexicon, container: Container) -> PhraseMatch:
        """Returns the request that the model proposes for a sentence, after all checks that a typed one gets.

        Raises:
            NotUnderstood: it proposes none, one that does not exist, or an order that the sentence does not ask for.
            ConfigurationError: the command cannot be run, fails, takes too long or prints too much.
        """
        asked = {"sentence": sentence, "requests": list(_offers(lexicon)), "names": _names(container)}
        try:
            proposal = msgspec.json.decode(self._ask(msgspec.json.encode(asked)), type=_Proposal)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as bad:
            raise _refused(sentence, f"answered no request as JSON ({bad}). Nothing was done") from None
        if not proposal.request:
            raise _refused(sentence, "knows no request for it either. `trade ask --phrases` lists what I understand")
        gaps = lexicon.named(proposal.gaps)
        phrase = None if proposal.request in DIALOGUE else lexicon.phrase(proposal.request, gaps)
        if phrase is None:
            shown = ", ".join(f"{gap}={text!r}" for gap, text in gaps.items())
            problem = f"proposed {proposal.request}({shown}), which no phrase of the lexicon means. Nothing was done"
            raise _refused(sentence, problem)
        if phrase.is_order:
            _require_asked(sentence, phrase, gaps.values())
        return PhraseMatch(phrase, gaps)

    def _ask(self, request: bytes) -> bytes:
        """Runs the command once; kills it, and all that it started, when it ends or its time is over."""
        with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as answer:
            given.write(request)
            given.seek(0)
            try:
                process = subprocess.Popen(  # noqa: S603 - the user names the command
                    self._command, stdin=given, stdout=answer, start_new_session=True
                )
            except OSError as bad:
                raise self._failed(f"cannot be run: {bad.strerror}") from None
            try:
                self._wait(process, answer)
            finally:
                _kill(process)
            if os.fstat(answer.fileno()).st_size > _MOST_BYTES:
                raise self._failed(f"printed more than {_MOST_BYTES >> 10} KiB. Nothing was done")
            if process.returncode:
                raise self._failed(f"failed with code {process.returncode}. Nothing was done")
            answer.seek(0)
            return answer.read()

    def _wait(self, process: "subprocess.Popen[bytes]", answer: IO[bytes]) -> None:
        """Waits for its end, or until it has printed too much; it is not reaped, so that its group keeps its number."""
        until, options = time.monotonic() + self._limit_s, os.WEXITED | os.WNOHANG | os.WNOWAIT
        while os.waitid(os.P_PID, process.pid, options) is None:
            if time.monotonic() > until:
                raise self._failed(f"took more than {self._limit_s:g} s. Nothing was done")
            if os.fstat(answer.fileno()).st_size > _MOST_BYTES:
                return
            time.sleep(_LOOK_S)

    def _failed(self, problem: str) -> ConfigurationError:
        return ConfigurationError(where=f"--model {shlex.join(self._command)}", problem=problem)


def _kill(process: "subprocess.Popen[bytes]") -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):  # all of it has ended
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_END_S)


def _refused(sentence: str, problem: str) -> NotUnderstood:
    return NotUnderstood(where=repr(sentence), problem=f"the model {problem}")


def _offers(lexicon: Lexicon) -> Iterator[dict[str, Any]]:
    """The requests that the model may propose."""
    for phrase in lexicon.phrases:
        if phrase.ask not in DIALOGUE:
            gaps, needed = lexicon.gaps_of(phrase)
            offer = {"request": phrase.means, "gaps": gaps, "needed": needed}
            yield {**offer, "order": phrase.is_order, "examples": phrase.hear}


def _names(container: Container) -> dict[str, list[str]]:
    handles = others(container)
    found = {
        "groups": {group for handle in handles for group in handle.groups},
        "containers": {handle.container for handle in handles},
        "hosts": {handle.host for handle in handles},
    }
    return {kind: sorted(names)[:_MOST_NAMES] for kind, names in found.items()}


def _require_asked(sentence: str, phrase: Phrase, names: Iterable[str]) -> None:
    """Raises NotUnderstood: the model proposes an order, but the sentence is a question or is about something else."""
    if is_question(sentence):
        problem = f"proposed an order ({phrase.means}) for a question. Nothing was done. Say an order in the imperative"
        raise _refused(sentence, problem)
    spoken = _content(sentence)
    meant = set[str]().union(*map(_content, [*phrase.hear, *names]))
    if not any(one == other or one[:_LEAST_SHARED] == other[:_LEAST_SHARED] for one in spoken for other in meant):
        problem = f"proposed an order ({phrase.means}) that the sentence does not ask for. Nothing was done"
        raise _refused(sentence, problem)


def _content(text: str) -> set[str]:
    """The words of a text that say what it is about."""
    words = re.findall(r"[\w-]+", re.sub(r"\{\w+\}", " ", text.lower()))
    return {word for word in words if len(word) >= _LEAST_SHARED and not _WEAK.fullmatch(word)}
