"""Announces the services of this container: sends each change at once, answers queries, and numbers revisions."""

import logging
import threading
from typing import Final

from trade.protocol.keys import Address, alive_key, registry_key, tally_key
from trade.protocol.messages import PROTOCOL, ProviderInfo, Tally, encode_message
from trade.transport.base import ChannelClosed, Presence, Question, Transport

_logger = logging.getLogger("trade")

SELDOM: Final = 8
"""A container with no news announces its revision every this many beats."""
_MOST_A_BEAT: Final = 4
"""Among many containers it does so less often: each of them receives at most this many revisions in a beat."""


class Announcer:
    """Owns the current announcements. One thread announces at a time; its own thread answers queries.

    Each announcement has the next revision number, whatever provider it is about, so a container that misses one can
    query for it. Nothing is sent before `appear`: no container would take it. Without a hub, all query it then anyway.
    """

    def __init__(self, transport: Transport, own: Address) -> None:
        self._transport = transport
        self._own = own
        self._lock = threading.Lock()
        self._current: dict[str, bytes] = {}
        self._revision = 0
        self.introduced = False
        """Whether announcements are sent."""
        self._quiet = 0
        """Beats since the last announcement."""
        self._questions = transport.questions(registry_key("*", own, "*"))
        self._thread = threading.Thread(target=self._answer_all, name="trade-answers", daemon=True)
        self._thread.start()

    def appear(self) -> Presence:
        """Publish the container's sign of life, and send all later announcements, or those from `introduce` on.

        Raises:
            ChannelClosed: the transport was closed.
        """
        self.introduced = not self._transport.relayed
        return self._transport.appear(alive_key(self._own))

    def introduce(self) -> None:
        """Announce all that there is, and the revision: who hears all of it needs no query.

        Raises:
            ChannelClosed: the transport was closed.
        """
        with self._lock:
            self.introduced = True
            current, revision = list(self._current.items()), self._revision
        for key, payload in current:
            self._transport.announce(key, payload)
        self._transport.announce(tally_key(self._own), encode_message(Tally(PROTOCOL, revision)))

    def announce(self, domain: str, provider: str, info: ProviderInfo) -> None:
        """Announce a provider to all containers, or its end if it has no services.

        Raises:
            ChannelClosed: the transport was closed.
        """
        key, payload = registry_key(domain, self._own, provider), encode_message(info)
        with self._lock:
            self._revision, self._quiet = info.revision, 0
            if info.services:
                self._current[key] = payload
            else:
                self._current.pop(key, None)
            introduced = self.introduced
        if introduced:
            self._transport.announce(key, payload)

    def beat(self, containers: int) -> None:
        """Announce the current revision if it is due, for containers that missed the last announcement.

        It is due at the first beat after an announcement, the second, the fourth and so on, then at every eighth
        (`SELDOM`), or less often among many: all containers receive it.

        Args:
            containers: how many this one knows.

        Raises:
            ChannelClosed: the transport was closed.
        """
        with self._lock:
            self._quiet += 1
            quiet, revision = self._quiet, self._revision
        seldom = max(SELDOM, containers // _MOST_A_BEAT)
        if quiet % seldom == 0 or (quiet < seldom and quiet.bit_count() == 1):
            self._transport.announce(tally_key(self._own), encode_message(Tally(PROTOCOL, revision)))

    def _answer_all(self) -> None:
        while True:
            try:
                question = self._questions.receive()
            except ChannelClosed:
                return
            try:
                self._answer(question)
            except ChannelClosed:  # the querying container is gone
                continue
            except Exception:
                _logger.exception("a query for the current announcements could not be answered")
            finally:
                question.close()

    def _answer(self, question: Question) -> None:
        with self._lock:
            current, revision = list(self._current.items()), self._revision
        for key, payload in current:
            question.answer(key, payload)
        question.answer(tally_key(self._own), encode_message(Tally(PROTOCOL, revision)))

    def close(self) -> None:
        """Stop answering queries. Idempotent."""
        self._questions.close()
        if self._thread is not threading.current_thread():
            self._thread.join(2)
