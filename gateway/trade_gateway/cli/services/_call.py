"""``trade call GROUP.NAME ARGUMENT...``: calls one service and prints its result."""

import math
import re
import shlex
from collections.abc import Mapping
from typing import Annotated, Any, Final

import msgspec
import typer

from trade.protocol.keys import is_chunk
from trade.protocol.messages import ServiceInfo
from trade.protocol.schema import read_schema
from trade.stop_line import StopLines
from trade_gateway._usage import UsageError, find
from trade_gateway.terminal._calls import run_to_end
from trade_gateway.terminal._completion import containers, services
from trade_gateway.terminal._options import TIMING, Json, Wait
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import choice_of, visitor

_NO_NUMBER = re.compile(r"(?<![\w\"])(nan|inf|infinity)(?![\w\"])", re.IGNORECASE)
_WORD = re.compile(r"[^\W\d][\w ./-]*")
COMMAND: Final = {"context_settings": {"ignore_unknown_options": True}}
"""Lets negative numbers pass as arguments."""
_STOP: Final = "stop"
_STOP_LIMIT_S: Final = 3.0
_BRACKETS: Final = ("[", "{")
_ANGLE = re.compile(r"_rad(_s2?)?$")
_DEGREES = re.compile(r"(?<![\w.])(-?\d+(?:\.\d+)?)(?:deg|°)(?:/s2?)?(?![\w.])")
_TAKEN: Final = {
    "number": "a number",
    "integer": "an integer",
    "array": "a list",
    "object": "an object",
    "boolean": "true or false",
}
"""What a parameter takes, by JSON type."""
_NAMED = re.compile(r"([A-Za-z_]\w*)=(.*)", re.DOTALL)


def call(
    context: typer.Context,
    service: Annotated[
        str, typer.Argument(autocompletion=services, help="Group and name of the service: rosie.head.move_to.")
    ],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(help="Arguments as JSON, by position ('[0.3, -0.2]') or by name (speed_rad_s=30deg)."),
    ] = None,
    deadline: Annotated[
        float,
        typer.Option(min=0.001, rich_help_panel=TIMING, metavar="SECONDS", help="Deadline of the call, in seconds."),
    ] = 10.0,
    wait: Wait = 2.0,
    container: Annotated[
        str | None, typer.Option(autocompletion=containers, help="Call the service of this container.")
    ] = None,
    pick: Annotated[
        str | None,
        typer.Option(metavar="HOW", help="If several fit, call one: any, local, least_busy or nearest."),
    ] = None,
    traceback: Annotated[  # noqa: ARG001 - `main` prints errors
        bool, typer.Option("--traceback", help="If the service raises an error, print its whole traceback.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Call a service and print its result. Ctrl-C cancels a motion in progress.

    Numbers are rounded to six places; --json prints all digits.
    A service named stop is called on the stop line first, as `trade stop` does: with all stop services of its group.

    For example: trade call rosie.head.move_to '[0.3, -0.2]' speed_rad_s=0.5
    """
    check_brackets(arguments or [])
    if not (arguments or container or pick) and _stopped_by_line(context, service, deadline):
        Output(as_json=as_json).data(None)
        return
    with visitor(context) as visiting:
        handle = find(visiting, service, container, wait, pick).with_(deadline_s=deadline)
        args, kwargs = parse_arguments(arguments or [], handle.record.info)
        result = run_to_end(handle, *args, **kwargs)
    Output(as_json=as_json).data(result)


def _stopped_by_line(context: typer.Context, service: str, limit_s: float) -> bool:
    """Stops the group of a stop service on the stop line; whether that is enough, so that the call is done."""
    group, _, name = service.rpartition(".")
    if name != _STOP or not all(map(is_chunk, group.split("."))):
        return False
    asked = StopLines(choice_of(context).settings()).stop(group, f"trade call {service}", min(limit_s, _STOP_LIMIT_S))
    report = asked.wait_enough()
    return asked.is_enough() and service in report.stopped


def check_brackets(texts: list[str]) -> None:
    """Refuses lists and objects that are no JSON before a service is looked up. Raises UsageError."""
    for place, text in enumerate(texts):
        value = named.group(2) if (named := _NAMED.fullmatch(text)) else text
        if value[:1] in _BRACKETS:
            try:
                msgspec.json.decode(_DEGREES.sub(_radians, value))
            except msgspec.DecodeError as bad:
                raise _no_json(text, value, bad, texts[place + 1 :]) from None


def _no_json(text: str, value: str, bad: msgspec.DecodeError, rest: list[str]) -> UsageError:
    return UsageError(where=f"argument {text!r}", problem=f"is not JSON ({bad}); {_remedy(value, rest)}")


def parse_arguments(texts: list[str], info: ServiceInfo) -> tuple[list[Any], dict[str, Any]]:
    """Parses the arguments of a call from words of the command line.

    Words are JSON. Where the service takes a text, a word without quotes is that text. For angles, whose names end in
    ``_rad``, ``_rad_s`` or ``_rad_s2``, ``30deg`` is a number in degrees.

    Raises:
        UsageError: a word is not JSON, and the service takes no text there.
    """
    schema = read_schema(info.arguments_schema)
    places = [parameter.name for parameter in info.parameters if not parameter.keyword_only]
    args: list[Any] = []
    kwargs: dict[str, Any] = {}
    for place, text in enumerate(texts):
        named = _NAMED.fullmatch(text)
        name = named.group(1) if named else places[len(args)] if len(args) < len(places) else ""
        word = named.group(2) if named else text
        kinds = _kinds(schema.get("properties", {}).get(name, {}), schema.get("$defs", {}))
        try:
            value = _value(word, name, kinds)
        except msgspec.DecodeError as bad:
            taken = " or ".join(sorted({_TAKEN[kind] for kind in kinds if kind in _TAKEN}))
            if taken and _WORD.fullmatch(word) and not _NO_NUMBER.search(word):
                problem = f"{name} takes {taken}, and {word!r} is a text"
                raise UsageError(where=f"argument {text!r}", problem=problem) from None
            raise _no_json(text, word, bad, texts[place + 1 :]) from None
        if named:
            kwargs[name] = value
        else:
            args.append(value)
    return args, kwargs


def _value(text: str, name: str, kinds: set[str]) -> Any:
    """The value of a word for one parameter of these JSON types. Raises msgspec.DecodeError."""
    in_radians = _DEGREES.sub(_radians, text) if _ANGLE.search(name) else text
    try:
        value = msgspec.json.decode(in_radians)
    except msgspec.DecodeError:
        if "string" in kinds and text[:1] not in (*_BRACKETS, '"'):
            return text
        raise
    if kinds <= {"string", "null"} and "string" in kinds and not isinstance(value, str):
        return None if value is None and "null" in kinds else text
    return value


def _kinds(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> set[str]:
    """The JSON types that a schema allows."""
    if "$ref" in schema:
        return _kinds(definitions.get(str(schema["$ref"]).rpartition("/")[2], {}), definitions)
    if "anyOf" in schema:
        return set[str]().union(*(_kinds(one, definitions) for one in schema["anyOf"]))
    if "enum" in schema:
        return {"string" if isinstance(one, str) else "null" if one is None else "number" for one in schema["enum"]}
    kind = schema.get("type", "any")
    return set(kind) if isinstance(kind, list) else {str(kind)}  # pyright: ignore[reportUnknownArgumentType]


def _radians(found: re.Match[str]) -> str:
    return repr(math.radians(float(found[1])))


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
