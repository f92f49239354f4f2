"""What is said on the stop line: one line of JSON that asks, and two that answer."""

import math
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct

from trade._estop.broadcast import EstopReport
from trade._protocol.keys import is_chunk
from trade._protocol.messages import Estop, Malformed
from trade._stop_line.group_stop import StopReport

VERSION: Final = 1
LONGEST_REASON: Final = 500
MOST_BYTES: Final = 4096
"""Of a request, with its end of line."""
LONGEST_LIMIT_S: Final = 60.0


class StopRequest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One request. What a later version adds is ignored."""

    v: Annotated[int, Meta(ge=1)]
    ask: Literal["stop", "estop", "open"]
    by: Annotated[str, Meta(max_length=200)] = ""
    """``identity/container`` of who asks. A certificate outranks the identity."""
    group: Annotated[str, Meta(max_length=200)] = ""
    """Of ``stop``: what to stop."""
    id: Annotated[str, Meta(max_length=80)] = ""
    """Of ``estop``: names it. The same id, asked of several containers, is one e-stop."""
    reason: Annotated[str, Meta(max_length=LONGEST_REASON)] = ""
    pass_on: bool = True
    """Of ``estop``: give it to the whole system, and answer for all of it; else this container alone stops."""
    limit_s: float = 3.0


class StopAnswer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One line of the answer: ``taken`` at once, the rest when it is over."""

    v: int = VERSION
    taken: bool = False
    """It is being done."""
    who: str = ""
    """``identity/container`` of who answers."""
    estop: EstopReport | None = None
    stop: StopReport | None = None
    open: tuple[dict[str, Any], ...] | None = None
    """The e-stops that are open, as ``{"id", "by", "reason", "at", "told_by"}``."""
    error: str = ""
    """Name of the error, if it was not done."""
    why: str = ""


_requests: Final = msgspec.json.Decoder(StopRequest)
_answers: Final = msgspec.json.Decoder(StopAnswer)
_encoder: Final = msgspec.json.Encoder()


def encoded(message: StopRequest | StopAnswer) -> bytes:
    """One line."""
    return _encoder.encode(message) + b"\n"


def read_request(line: bytes) -> StopRequest:
    """Raises Malformed: it is none, and says why."""
    try:
        request = _requests.decode(line)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as bad:
        raise Malformed(str(bad)) from None
    if not all(map(is_chunk, request.by.split("/") if request.by else ())) or request.by.count("/") > 1:
        raise Malformed("by: IDENTITY/CONTAINER is wanted")
    if request.ask == "estop" and not is_chunk(request.id):
        raise Malformed("id: an e-stop has one of letters, digits, . _ -")
    if request.ask == "stop" and not all(map(is_chunk, request.group.split("."))):
        raise Malformed("group: the name of a group is wanted")
    if not (math.isfinite(request.limit_s) and 0 < request.limit_s <= LONGEST_LIMIT_S):
        raise Malformed(f"limit_s: above 0 and at most {LONGEST_LIMIT_S:g} is wanted")
    return request


def read_answer(line: bytes) -> StopAnswer:
    """Raises Malformed: it is none."""
    try:
        return _answers.decode(line)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as bad:
        raise Malformed(str(bad)) from None


def told(estop: Estop) -> dict[str, Any]:
    """An e-stop that is open, as an answer has it."""
    return {"id": estop.id, "by": estop.by, "reason": estop.reason, "at": estop.at, "told_by": estop.told_by}
