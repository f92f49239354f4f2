"""``trade ask "..."``: questions about a system, and orders to it, in plain sentences."""

import sys
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade.errors import TradeError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output, say_error
from trade_gateway.cli._system_choice import visitor_among_others
from trade_gateway.language import Lexicon, Memory, Reply, Talk, read_lexicon

_FILE: Final = "asked.json"


def ask(
    context: typer.Context,
    sentence: Annotated[list[str] | None, typer.Argument(help="What to ask; none: a dialogue, line by line.")] = None,
    lexicon: Annotated[Path | None, typer.Option(help="A file of phrases that go before those that are known.")] = None,
    phrases: Annotated[bool, typer.Option("--phrases", help="Show what is understood.")] = False,
    as_json: Json = False,
) -> None:
    """Ask about services, hosts, containers, locks, faults and what is new, in plain English sentences.

    Each becomes the calls that any program could make; a lexicon (TOML) says which, and can be added to.

    For example: trade ask "who has the legs?"
    """
    out, known = Output(as_json=as_json), read_lexicon(lexicon)
    if phrases:
        _show(out, known)
        return
    with visitor_among_others(context) as container:
        folder = container.settings.state_dir
        memory = Memory(None if folder is None else folder / container.settings.system / _FILE)
        talk = Talk(container, known, memory)
        if sentence:
            _answer(out, talk.say(" ".join(sentence)))
            return
        out.say("ask, a sentence a line; Ctrl-D ends")
        for line in sys.stdin:
            if line.strip():
                try:
                    _answer(out, talk.say(line))
                except TradeError as error:
                    say_error(error)


def _answer(out: Output, reply: Reply) -> None:
    if out.as_json:
        out.data(reply)
    out.say(escape(reply.text))


def _show(out: Output, known: Lexicon) -> None:
    if out.as_json:
        out.data(known.sentences)
    for sentence in known.sentences:
        out.say(escape(sentence))
