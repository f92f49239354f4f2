"""The messages of the stop line: one line of JSON as the request, and two as the answer."""

import math
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct

from trade._estop.broadcast import EstopReport
from trade.protocol.keys import is_chunk
from trade.protocol.messages import Estop, Malformed
from trade.stop_line.group_stop import StopReport

VERSION: Final = 1
LONGEST_REASON: Final = 500
MOST_BYTES: Final = 4096
"""The longest request, with its end of line."""
LONGEST_LIMIT_S: Final = 60.0


class StopRequest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A request. Fields that a later version adds are ignored."""

    v: Annotated[int, Meta(ge=1)]
    ask: Literal["stop", "estop", "open"]
    by: Annotated[str, Meta(max_length=200)] = ""
    """``identity/container`` of the client. The identity of a certificate has precedence."""
    group: Annotated[str, Meta(max_length=200)] = ""
    """For ``stop``: what to stop."""
    id: Annotated[str, Meta(max_length=80)] = ""
    """For ``estop``: its id. The same id, sent to several containers, is one e-stop."""
    reason: Annotated[str, Meta(max_length=LONGEST_REASON)] = ""
    pass_on: bool = True
    """For ``estop``: give it to the whole system, and answer for all of it; else only this container stops."""
    limit_s: float = 3.0


class StopAnswer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One line of the answer: ``taken`` at once, the result when it is over."""

    v: int = VERSION
    taken: bool = False
    """Whether the request is under way."""
    who: str = ""
    """``identity/container`` of the answering container."""
    estop: EstopReport | None = None
    stop: StopReport | None = None
    open: tuple[dict[str, Any], ...] | None = None
    """The open e-stops, as ``{"id", "by", "reason", "at", "told_by"}``."""
    error: str = ""
    """The name of the error, if the request was not done."""
    why: str = ""


_requests: Final = msgspec.json.Decoder(StopRequest)
_answers: Final = msgspec.json.Decoder(StopAnswer)
_encoder: Final = msgspec.json.Encoder()


def encoded(message: StopRequest | StopAnswer) -> bytes:
    """The message as one line."""
    return _encoder.encode(message) + b"\n"


def read_request(line: bytes) -> StopRequest:
    """Decodes a request. Raises Malformed, with the reason."""
    try:
        request = _requests.decode(line)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as bad:
        raise Malformed(str(bad)) from None
    if not all(map(is_chunk, request.by.split("/") if request.by else ())) or request.by.count("/") > 1:
        raise Malformed("by: must be IDENTITY/CONTAINER")
    if request.ask == "estop" and not is_chunk(request.id):
        raise Malformed("id: must consist of letters, digits, . _ -")
    if request.ask == "stop" and not all(map(is_chunk, request.group.split("."))):
        raise Malformed("group: must be the name of a group")
    if not (math.isfinite(request.limit_s) and 0 < request.limit_s <= LONGEST_LIMIT_S):
        raise Malformed(f"limit_s: must be above 0 and at most {LONGEST_LIMIT_S:g}")
    return request


def read_answer(line: bytes) -> StopAnswer:
    """Decodes an answer. Raises Malformed."""
    try:
        return _answers.decode(line)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as bad:
        raise Malformed(str(bad)) from None


def estop_fields(estop: Estop) -> dict[str, Any]:
    """An open e-stop, in the form of an answer."""
    return {"id": estop.id, "by": estop.by, "reason": estop.reason, "at": estop.at, "told_by": estop.told_by}
