"""``trade ask "..."``: questions and commands to a system, in plain sentences."""

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
    sentence: Annotated[list[str] | None, typer.Argument(help="The question; by default a dialogue.")] = None,
    lexicon: Annotated[Path | None, typer.Option(help="TOML file of further phrases.")] = None,
    phrases: Annotated[bool, typer.Option("--phrases", help="List the sentences that it understands.")] = False,
    as_json: Json = False,
) -> None:
    """Ask about services, containers, locks, faults and news in plain English.

    A lexicon (TOML) translates each sentence into ordinary calls. You can add phrases with --lexicon.

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
        out.say("type one sentence per line; Ctrl-D ends")
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
