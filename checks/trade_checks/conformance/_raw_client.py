"""A client that sends raw messages to the container under test, including those that no valid client sends."""

import itertools
import secrets
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import msgspec

from trade.protocol.keys import Address, alive_key, call_key, reply_key
from trade.protocol.messages import (
    CANCEL,
    PROTOCOL,
    Behalf,
    ErrorInfo,
    Malformed,
    Reply,
    Status,
    Token,
    decode_reply,
    encode_message,
)
from trade.protocol.remote_errors import unpack_error
from trade.transport.base import ChannelClosed, Publisher, Transport
from trade_checks.conformance._assertions import PATIENCE_S, NotHeld, eventually, require

Place = tuple[str, str]
"""Domain and provider."""
SYSTEM: Final[Place] = ("trade", "system")
DEADLINE_S: Final = 8.0
NEVER: Final = object()
"""The expiry of a call that never expires."""

PARTING_S: Final = 2.0
"""How long a reader may take to end. The end of the interpreter would abort one that is inside the transport."""


class RawClient:
    """A client with its own identity, whose session has a sign of life until it is closed."""

    def __init__(
        self, transport: Transport, identity: str, callee: Address, *, client: str = "1", motion: bool = False
    ) -> None:
        self._transport = transport
        self._motion = motion
        self.callee: Final = callee
        self.identity: Final = identity
        epoch = secrets.token_hex(6)
        self.session: Final = f"{identity}/suite/{epoch}/{client}" if client else f"{identity}/suite/{epoch}"
        self._channel: Final = f"{epoch}.r"
        self._answers = transport.subscribe(reply_key("*", identity, "suite", self._channel))
        self._replies: dict[int, list[Reply]] = {}
        self._changed = threading.Condition()
        self.new_id: Final = itertools.count(secrets.randbits(38) << 24 | 1).__next__
        self._publishers: dict[str, Publisher] = {}
        self._offset_ns: int | None = None
        self._sign = transport.appear(alive_key(self.session))
        self._reader = threading.Thread(target=self._read, name="suite-replies", daemon=True)
        self._reader.start()

    # --- requests

    def put(self, key: str, payload: bytes, *, urgent: bool = False) -> None:
        """Puts any bytes on any key."""
        if key not in self._publishers:
            self._publishers[key] = self._transport.publish(key, urgent=urgent)
        self._publishers[key].put(payload)

    def call(
        self,
        place: Place,
        service: str,
        *args: Any,
        by_name: dict[str, Any] | None = None,
        call_id: int | None = None,
        expires_ns: Any = None,
        stop: bool = False,
        tokens: Sequence[Token] = (),
        sessions: Sequence[str] = (),
        session: str = "",
        version: int = PROTOCOL,
        appended: Sequence[Any] = (),
        callee: Address | None = None,
        key: str = "",
    ) -> int:
        """Sends a call and returns its id. By default it expires after a sufficient time, by the callee's clock."""
        require(self._motion or service != "turn", "a check without `still` ran without --motion")
        asked = self.new_id() if call_id is None else call_id
        if expires_ns is None and not stop:
            expires_ns = self.expiry_ns()
        behalf = Behalf(tuple(sessions), (), tuple(tokens)) if tokens or sessions else None
        message = [
            version,
            asked,
            service,
            f"suite/{self._channel}",
            session or self.session,
            None if expires_ns is NEVER else expires_ns,
            (),
            args if by_name is None else by_name,
            behalf,
            *appended,
        ]
        where = key or call_key(self.identity, callee or self.callee, *place, stop=stop)
        self.put(where, encode_message(message), urgent=stop)
        return asked

    def ask(self, place: Place, service: str, *args: Any, **how: Any) -> Reply:
        """Calls and waits for the answer."""
        return self.answer(self.call(place, service, *args, **how))

    def result(self, place: Place, service: str, *args: Any, **how: Any) -> Any:
        """Calls and returns the result; raises NotHeld if the call failed."""
        return body_of(self.ask(place, service, *args, **how), f"{place[0]}.{service}")

    def cancel(self, call_id: int, service: str, keep_s: float = DEADLINE_S) -> Reply:
        """Cancels a call."""
        return self.ask(SYSTEM, CANCEL, call_id, service, keep_s, stop=True)

    def expiry_ns(self, in_s: float = DEADLINE_S) -> int:
        """A time, in seconds from now, by the callee's clock, rounded towards earlier."""
        if self._offset_ns is None:
            answer = self.answer(self.call(SYSTEM, "clock", expires_ns=NEVER))
            self._offset_ns = answer.clock_ns - time.monotonic_ns()
        return time.monotonic_ns() + self._offset_ns + int(in_s * 1e9)

    # --- answers

    def answer(self, call_id: int, wait_s: float = PATIENCE_S) -> Reply:
        """The answer to a call; raises NotHeld if none arrives."""
        eventually(lambda: self.answers(call_id), "there was no answer to a call", wait_s)
        return self.answers(call_id)[0]

    def answers(self, call_id: int) -> list[Reply]:
        """All answers to a call that have arrived."""
        with self._changed:
            return [reply for reply in self._replies.get(call_id, ()) if reply.status != Status.PROGRESS]

    def _read(self) -> None:
        while True:
            try:
                message = self._answers.receive()
                _, callee, *_ = message.key.split("/")
                reply = decode_reply(message.payload or b"")
            except ChannelClosed:
                return
            except Malformed:
                continue
            if callee == self.callee.identity:
                with self._changed:
                    self._replies.setdefault(reply.id, []).append(reply)

    def close(self) -> None:
        """Ends its session. Idempotent."""
        self._sign.close()
        self._answers.close()
        self._reader.join(PARTING_S)
        for publisher in self._publishers.values():
            publisher.close()

    def __enter__(self) -> "RawClient":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def body_of(reply: Reply, what: str) -> Any:
    """The result in an answer; raises NotHeld if it is an error."""
    if reply.status == Status.OK:
        return msgspec.msgpack.decode(reply.body)
    detail = f": {error_of(reply)}" if reply.status == Status.ERROR else ""
    raise NotHeld(f"{what} was answered with status {reply.status}{detail}")


def error_of(reply: Reply) -> BaseException:
    """The exception that a Python caller would get; raises NotHeld if the answer is no error."""
    if reply.status != Status.ERROR:
        raise NotHeld(f"the answer should be an error (status 1), but has status {reply.status}")
    try:
        return unpack_error(msgspec.msgpack.decode(reply.body, type=ErrorInfo), "it")
    except msgspec.DecodeError as bad:
        raise NotHeld(f"the body of an error is not an ErrorInfo: {bad}") from None
