# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Services of ROS 2.

Facts, from ros2/rmw_zenoh (``rmw_service_data.cpp``, ``rmw_client_data.cpp``): a service is a complete queryable at its
key; the request is the query's payload, the response the reply's, both CDR, each with an attachment. In ROS 2 a
service cannot report a failure. Here it sends an error reply of zenoh; a client of ROS 2 logs it and keeps waiting.

ROS 2 asks every server of a name and takes the first answer. Here only one of them is asked, so a request runs once.
"""

import contextlib
import itertools
import logging
import queue
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import zenoh

from trade_gateway.ros._graph import Answer, RosRefused, RosUnreachable
from trade_gateway.ros._mailbox import AtOnce, Mailbox
from trade_gateway.ros.ros2._link import CLOSED, ZenohDeclaration
from trade_gateway.ros.ros2._names import TokenKind
from trade_gateway.ros.ros2._node import Endpoint, Node
from trade_gateway.ros_messages._types import Message

_MOST_WAITING: Final = 10
_LATE_S: Final = 5.0
"""S01: a request that waited longer is refused, not executed; its client has given up."""
_MOST_STOPS: Final = 64
"""How many stops of one service are answered at a time; more wait, but none is refused for that (S07)."""
_AFTER_S: Final = 5.0
"""How much later zenoh's own deadline is than ours; only requests that expire by themselves reach it."""

_log: Final = logging.getLogger("trade")


class ServiceRequest:
    """A received request. It must be ended by one of its methods."""

    def __init__(
        self, query: zenoh.Query, endpoint: Endpoint, node: Node, type_name: str, *, stops: bool = False
    ) -> None:
        """stops: it waits for nothing, not even for the name of its client."""
        self._query = query
        self._endpoint = endpoint
        self._node = node
        self._type_name = type_name
        self._sender = node.sender(query.attachment)
        self._stops = stops
        self.came_at: Final = time.monotonic()

    def request(self) -> Message:
        """The content of the request. Raises ValueError: it is malformed."""
        payload = self._query.payload
        return self._node.types.from_bytes(f"{self._type_name}_Request", b"" if payload is None else payload.to_bytes())

    def who(self) -> str:
        """The client's node, or empty. May wait shortly, unless it is a stop."""
        return self._sender.name(waits=not self._stops)

    def answer(self, response: Mapping[str, Any]) -> None:
        """Sends the response. Raises ConfigurationError: it does not fit the type."""
        payload = self._node.types.to_bytes(f"{self._type_name}_Response", response)
        with contextlib.suppress(*CLOSED), self._query:
            self._query.reply(self._endpoint.key, payload, attachment=self._attachment(), express=True)

    def refuse(self, problem: str) -> None:
        """Reports that the request failed."""
        with contextlib.suppress(*CLOSED), self._query:
            self._query.reply_err(problem.encode())

    def _attachment(self) -> bytes | None:
        attachment = self._sender.attached
        return None if attachment is None else attachment._replace(time_ns=time.time_ns()).to_bytes()


class Server:
    """A service server. Its thread handles the requests in turn, and refuses one that has waited too long.

    A request of a service that stops something runs at once, on its own thread, and is never refused for its age.
    """

    def __init__(
        self, node: Node, name: str, type_name: str, handle: Callable[[ServiceRequest], object], *, stops: bool = False
    ) -> None:
        self._endpoint = node.service(TokenKind.SERVER, name, type_name)
        self._node = node
        self._type_name = type_name
        self._handle = handle
        self._stops = stops
        self._mailbox: Mailbox[ServiceRequest] | AtOnce[ServiceRequest] = (
            AtOnce(f"ros2 {name}", self._try, most=_MOST_STOPS, drop=self._late)
            if stops
            else Mailbox(f"ros2 {name}", self._try, most=_MOST_WAITING, longest_s=_LATE_S, drop=self._late)
        )
        self._declared = node.link.declare(self._declare)

    def close(self) -> None:
        """Ends the service. Idempotent."""
        self._declared.close()
        self._mailbox.close()

    def _declare(self, session: zenoh.Session) -> Sequence[ZenohDeclaration]:
        queryable = session.declare_queryable(self._endpoint.key, self._put, complete=True)
        return session.liveliness().declare_token(self._endpoint.token), queryable

    def _put(self, query: zenoh.Query) -> None:
        self._mailbox.put(ServiceRequest(query, self._endpoint, self._node, self._type_name, stops=self._stops))

    def _late(self, asked: ServiceRequest) -> None:
        asked.refuse("not executed: it waited too long behind other requests, or the service has ended")

    def _try(self, asked: ServiceRequest) -> None:
        try:
            self._handle(asked)
        except Exception as failed:  # noqa: BLE001 - reported to the caller, whatever it is
            _log.warning("%s failed: %s", self._endpoint.key, failed)
            asked.refuse(f"{type(failed).__name__}: {failed}")


def answering(answer: Answer) -> Callable[[ServiceRequest], object]:
    """Handles requests by a function that returns the response."""
    return lambda asked: asked.answer(answer(asked.request(), asked.who(), asked.came_at))


class Unanswered(NamedTuple):
    """The absence of a response."""

    problem: str
    sent: bool
    """Whether a node may have received the request, and executed it."""


class Client:
    """A client of a ROS service."""

    def __init__(self, node: Node, name: str, type_name: str) -> None:
        self._endpoint = node.service(TokenKind.CLIENT, name, type_name)
        self._node = node
        self.name: Final = name
        self._type_name = type_name
        self._sequence = itertools.count(1)
        self._declared = node.link.declare(self._declare)

    def call(self, request: Mapping[str, Any], timeout_s: float) -> Message:
        """See `Graph.call`."""
        answer = self.ask(request, timeout_s)
        if isinstance(answer, Unanswered):
            raise RosUnreachable(what=self.name, problem=answer.problem)
        return answer

    def ask(self, request: Mapping[str, Any], timeout_s: float) -> Message | Unanswered:
        """The same for callers that must know whether the request was sent.

        Raises:
            RosRefused: the service failed.
            ConfigurationError: the request does not fit.
        """
        payload = self._node.types.to_bytes(f"{self._type_name}_Request", request)
        answers: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        was_there = self._is_present()
        try:
            cancel = self._ask(payload, timeout_s, answers.put, lambda: answers.put(None))
        except RosUnreachable as unreachable:
            return Unanswered(unreachable.problem, sent=False)
        try:
            reply = answers.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            problem = f"did not answer within {timeout_s:g} s; whether it did what was asked is unknown"
            return Unanswered(problem, sent=True)
        finally:
            cancel()
        if reply is None:
            missing = f"no node serves it as {self._type_name}, or the one that does ended before it answered"
            cut_off = self._node.link.problem
            return Unanswered(cut_off or missing, sent=bool(cut_off) or was_there or self._is_present())
        return self._read(reply)

    def send(self, request: Mapping[str, Any], timeout_s: float) -> None:
        """Calls it without waiting for the response. Raises RosUnreachable: no router."""
        payload = self._node.types.to_bytes(f"{self._type_name}_Request", request)
        self._ask(payload, timeout_s, lambda _: None, lambda: None)

    def close(self) -> None:
        """Withdraws the client. Idempotent."""
        self._declared.close()

    def _is_present(self) -> bool:
        return self._node.presence.offered(TokenKind.SERVER, self.name)

    def _ask(
        self, payload: bytes, timeout_s: float, replied: Callable[[zenoh.Reply], object], ended: Callable[[], object]
    ) -> Callable[[], object]:
        session, problem = self._node.link.session, self._node.link.problem
        if session is None or problem:
            raise RosUnreachable(what=self.name, problem=problem)
        cancellation = zenoh.CancellationToken()
        try:
            session.get(
                self._endpoint.key,
                zenoh.handlers.Callback(replied, ended),
                target=zenoh.QueryTarget.BEST_MATCHING,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s + _AFTER_S,
                payload=payload,
                attachment=self._endpoint.attachment(next(self._sequence)),
                cancellation_token=cancellation,
            )
        except CLOSED as closed:
            raise RosUnreachable(what=self.name, problem=f"the session ended: {closed}") from None
        return cancellation.cancel

    def _read(self, reply: zenoh.Reply) -> Message:
        if reply.err is not None:
            raise RosRefused(what=self.name, problem=reply.err.payload.to_bytes().decode(errors="replace"))
        payload = b"" if reply.ok is None else reply.ok.payload.to_bytes()
        try:
            return self._node.types.from_bytes(f"{self._type_name}_Response", payload)
        except ValueError as malformed:
            raise RosRefused(what=self.name, problem=f"its answer cannot be read: {malformed}") from None

    def _declare(self, session: zenoh.Session) -> Sequence[ZenohDeclaration]:
        return [session.liveliness().declare_token(self._endpoint.token)]
