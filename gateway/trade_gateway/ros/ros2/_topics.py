# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportCallIssue=false
"""Topics of ROS 2.

Facts, from ros2/rmw_zenoh (``rmw_publisher_data.cpp``, ``rmw_subscription_data.cpp``): a message is a put of its CDR
with an attachment. A transient local publisher is an advanced one of zenoh with a cache of its depth. It can be
detected and announces what it sent last; a transient local subscription queries such caches.
"""

import contextlib
import itertools
import logging
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Final

import zenoh
import zenoh.ext

from trade_gateway.ros._graph import Heard
from trade_gateway.ros._mailbox import Mailbox
from trade_gateway.ros.ros2._link import CLOSED, ZenohDeclaration
from trade_gateway.ros.ros2._names import TokenKind
from trade_gateway.ros.ros2._node import LATCHED, USUAL, Node, Sender

_DEPTH: Final = 10
_LATE_S: Final = 1.0
"""S01, S04: a message that waited longer for a busy subscriber is dropped: it may be a command."""
_HEARTBEAT_S: Final = 0.5

_Came = tuple[zenoh.Sample, Sender]

_log: Final = logging.getLogger("trade")


class Topic:
    """A published topic."""

    def __init__(self, node: Node, topic: str, type_name: str, *, latched: bool) -> None:
        self._endpoint = node.topic(TokenKind.PUBLISHER, topic, type_name, LATCHED if latched else USUAL)
        self._types = node.types
        self._type_name = type_name
        self._latched = latched
        self._last: bytes | None = None
        self._sequence = itertools.count(1)
        self._sending = threading.Lock()
        self._publisher: Any = None
        self._declared = node.link.declare(self._declare)

    def send(self, message: Mapping[str, Any]) -> None:
        """See `Publisher`. Without a router only the last latched message is kept."""
        payload = self._types.to_bytes(self._type_name, message)
        with self._sending:
            if self._latched:
                self._last = payload
            self._put(payload)

    def close(self) -> None:
        """Stops publishing. Idempotent."""
        self._declared.close()
        with self._sending:
            self._publisher = None

    def _put(self, payload: bytes) -> None:
        if self._publisher is not None:
            with contextlib.suppress(*CLOSED):
                self._publisher.put(payload, attachment=self._endpoint.attachment(next(self._sequence)))

    def _declare(self, session: zenoh.Session) -> Sequence[ZenohDeclaration]:
        publisher = self._advanced(session) if self._latched else self._plain(session)
        token = session.liveliness().declare_token(self._endpoint.token)
        with self._sending:
            self._publisher = publisher
            if self._last is not None:
                self._put(self._last)
        return token, publisher

    def _plain(self, session: zenoh.Session) -> zenoh.Publisher:
        return session.declare_publisher(
            self._endpoint.key, congestion_control=zenoh.CongestionControl.DROP, express=True
        )

    def _advanced(self, session: zenoh.Session) -> Any:
        return zenoh.ext.declare_advanced_publisher(
            session,
            self._endpoint.key,
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(sporadic_heartbeat=_HEARTBEAT_S),
            publisher_detection=True,
        )


class TopicSubscription:
    """A topic subscription."""

    def __init__(self, node: Node, topic: str, type_name: str, callback: Heard, *, latched: bool) -> None:
        self._endpoint = node.topic(TokenKind.SUBSCRIPTION, topic, type_name, LATCHED if latched else USUAL)
        self._node = node
        self._type_name = type_name
        self._callback = callback
        self._latched = latched
        longest_s = float("inf") if latched else _LATE_S
        self._mailbox = Mailbox[_Came](f"ros2 {topic}", self._tell, most=_DEPTH, longest_s=longest_s)
        self._declared = node.link.declare(self._declare)

    def close(self) -> None:
        """Ends the subscription. Idempotent."""
        self._declared.close()
        self._mailbox.close()

    def _put(self, sample: zenoh.Sample) -> None:
        self._mailbox.put((sample, self._node.sender(sample.attachment)))

    def _tell(self, received_at: _Came) -> None:
        sample, sender = received_at
        try:
            message = self._node.types.from_bytes(self._type_name, sample.payload.to_bytes())
        except ValueError as malformed:
            _log.warning("a message on %s is dropped: %s", sample.key_expr, malformed)
            return
        self._callback(message, sender.name())

    def _declare(self, session: zenoh.Session) -> Sequence[ZenohDeclaration]:
        token = session.liveliness().declare_token(self._endpoint.token)
        if not self._latched:
            return token, session.declare_subscriber(self._endpoint.key, self._put)
        subscriber: Any = zenoh.ext.declare_advanced_subscriber(
            session,
            self._endpoint.key,
            self._put,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True),
            subscriber_detection=True,
        )
        return token, subscriber
