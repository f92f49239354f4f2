"""``trade ask "..."``: questions and orders to a system, in plain sentences."""

import sys
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade_gateway._usage import UsageError
from trade_gateway.language import Dialogue, Lexicon, Memory, Model, Reply, read_lexicon
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, say_error
from trade_gateway.terminal._system_choice import choice_of, visitor_among_others

SECTION: Final = sections.SERVICES
PLACE: Final = 6
_FILE: Final = "asked.json"


def ask(
    context: typer.Context,
    sentence: Annotated[list[str] | None, typer.Argument(help="The sentence; by default a dialogue.")] = None,
    lexicon: Annotated[Path | None, typer.Option(help="TOML file of further phrases and names.")] = None,
    phrases: Annotated[bool, typer.Option("--phrases", help="List the sentences that it understands.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Confirm the order in the sentence.")] = False,
    model: Annotated[
        str | None,
        typer.Option(metavar="COMMAND", help="Command of a language model, for sentences that are not understood."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Ask about services, locks, faults and news, or give an order, in plain English.

    A lexicon (TOML) translates each sentence into ordinary calls. You can add phrases with --lexicon.
    An order that moves or reconfigures something needs a confirmation: a yes in a dialogue, else --yes.
    The exit code is 1 if an order was not confirmed, and nothing was done.

    For example: trade ask "who has the legs?"
    """
    out, known = Output(as_json=as_json), read_lexicon(lexicon)
    if phrases:
        _show(out, known)
        return
    if yes and not sentence:
        raise UsageError(where="--yes", problem="it confirms the order of one sentence. A dialogue asks for each order")
    reader = None if model is None else Model(model)
    with visitor_among_others(context) as container:
        settings = choice_of(context).settings()
        folder = container.settings.state_dir
        dialogue = Dialogue(
            container,
            known,
            Memory(None if folder is None else folder / container.settings.system / _FILE),
            audit=settings.audit,
            model=reader,
            show=lambda request: out.say(f"the model proposes {escape(request)}"),
            keeps=not sentence,
        )
        try:
            if sentence:
                _once(out, dialogue.say(" ".join(sentence), confirmed=yes))
            else:
                _dialogue(out, dialogue)
        finally:
            dialogue.close()


def _once(out: Output, reply: Reply) -> None:
    """Answers the only sentence; an order without a confirmation ends with code 1."""
    if out.as_json:
        out.data(reply)
    if not reply.waits:
        out.say(escape(reply.text))
        return
    if reply.waits == "yes":
        out.say(f"I would {escape(reply.data)}. Nothing was done. Add --yes to confirm it.")
    else:
        out.say(f"{escape(reply.text)} Nothing was done. Name it in the sentence.")
    raise typer.Exit(1)


def _dialogue(out: Output, dialogue: Dialogue) -> None:
    out.say("type one sentence per line; Ctrl-D ends")
    for line in sys.stdin:
        if line.strip():
            try:
                _answer(out, dialogue.say(line))
            except Exception as error:  # noqa: BLE001 - the dialogue and its locks continue
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
