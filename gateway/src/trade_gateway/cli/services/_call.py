"""``trade call GROUP.NAME ARGUMENT...``: calls one service and prints its result."""

import re
import shlex
import signal
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import Annotated, Any, Final

import msgspec
import typer

from trade import Handle
from trade.errors import TradeError
from trade_gateway._usage import UsageError, find
from trade_gateway.cli._options import TIMING, Json, Wait
from trade_gateway.cli._output import Output, say_error
from trade_gateway.cli._system_choice import visitor

_NO_NUMBER = re.compile(r"(?<![\w\"])(nan|inf|infinity)(?![\w\"])", re.IGNORECASE)
_WORD = re.compile(r"[^\W\d][\w ./-]*")
COMMAND: Final = {"context_settings": {"ignore_unknown_options": True}}
"""Lets negative numbers pass as arguments."""
_NAMED = re.compile(r"([A-Za-z_]\w*)=(.*)", re.DOTALL)


def call(
    context: typer.Context,
    service: Annotated[str, typer.Argument(help="Group and name of the service: rosie.head.move_to.")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(help="Arguments as JSON, by position ('[0.3, -0.2]') or by name (speed_rad_s=0.5)."),
    ] = None,
    deadline: Annotated[
        float,
        typer.Option(min=0.001, rich_help_panel=TIMING, metavar="SECONDS", help="Deadline of the call, in seconds."),
    ] = 10.0,
    wait: Wait = 2.0,
    container: Annotated[str | None, typer.Option(help="Call the service of this container.")] = None,
    as_json: Json = False,
) -> None:
    """Call a service and print its result. Ctrl-C cancels a motion in progress.

    Numbers are rounded to six places; --json prints all digits.

    For example: trade call rosie.head.move_to '[0.3, -0.2]' speed_rad_s=0.5
    """
    args, kwargs = parse_arguments(arguments or [])
    with visitor(context) as visiting:
        handle = find(visiting, service, container, wait).with_(deadline_s=deadline)
        result = run_to_end(handle, *args, **kwargs)
    Output(as_json=as_json).data(result)


def run_to_end(handle: Handle, *args: Any, **kwargs: Any) -> Any:
    """Calls a service; Ctrl-C and similar signals cancel the call and raise KeyboardInterrupt."""
    with _interruptible():
        run = handle.start(*args, **kwargs)
        try:
            return run.result()
        except KeyboardInterrupt:
            _cancel(handle)
            raise


@contextmanager
def _interruptible() -> Generator[None]:
    """Makes SIGTERM and SIGHUP end a call as Ctrl-C does, so that its motion is stopped."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    before = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _cancel(handle: Handle) -> None:
    """Cancels the call after Ctrl-C, and reports if that failed."""
    try:
        handle.cancel_service()()
    except TradeError as error:
        say_error(error)


def parse_arguments(texts: list[str]) -> tuple[list[Any], dict[str, Any]]:
    """Parses the arguments of a call from words of the command line.

    Raises:
        UsageError: a word is not JSON.
    """
    args: list[Any] = []
    kwargs: dict[str, Any] = {}
    for place, text in enumerate(texts):
        named = _NAMED.fullmatch(text)
        try:
            if named is None:
                args.append(msgspec.json.decode(text))
            else:
                kwargs[named.group(1)] = msgspec.json.decode(named.group(2))
        except msgspec.DecodeError as bad:
            problem = f"is not JSON ({bad}); {_remedy(named.group(2) if named else text, texts[place + 1 :])}"
            raise UsageError(where=f"argument {text!r}", problem=problem) from None
    return args, kwargs


def _remedy(value: str, rest: list[str]) -> str:
    """Suggests a correction for a word that is not JSON, from the words that follow it."""
    if _NO_NUMBER.search(value):
        return "JSON has no NaN and no infinity, and what moves takes neither"
    for count in range(1, len(rest) + 1 if value[:1] in ("[", "{", '"') else 0):
        if _is_json(whole := " ".join([value, *rest[:count]])):
            return f"forgot quotes? The shell splits at spaces: {shlex.quote(whole)}"
    if _WORD.fullmatch(value):
        return f"forgot quotes? A text is written {shlex.quote(msgspec.json.encode(value).decode())}"
    return """write numbers as 0.3, lists as '[0.3, -0.2]', texts as '"left"'; forgot quotes?"""


def _is_json(text: str) -> bool:
    try:
        msgspec.json.decode(text)
    except msgspec.DecodeError:
        return False
    return True
