"""What this container announces: told at once, kept for those who ask, and counted so that nobody misses any of it."""

import logging
import threading
from typing import Final

from trade._protocol.keys import Address, alive_key, registry_key, tally_key
from trade._protocol.messages import PROTOCOL, ProviderInfo, Tally, encode_message
from trade._transport.base import ChannelClosed, Presence, Question, Transport

_logger = logging.getLogger("trade")

SELDOM: Final = 8
"""Every how many beats who has nothing new says how far it is."""


class Announcer:
    """Owns what stands. One at a time announces; a thread of its own answers who asks.

    The revision of each announcement is one more than that of the one before, whatever it is about: who finds one
    missing asks. Nothing is sent before `appear`: nobody takes it up, and everybody asks then.
    """

    def __init__(self, transport: Transport, own: Address) -> None:
        self._transport = transport
        self._own = own
        self._lock = threading.Lock()
        self._standing: dict[str, bytes] = {}
        self._revision = 0
        self._shown = False
        self._quiet = 0
        """Beats since the last announcement."""
        self._questions = transport.questions(registry_key("*", own, "*"))
        self._thread = threading.Thread(target=self._answer_all, name="trade-answers", daemon=True)
        self._thread.start()

    def appear(self) -> Presence:
        """Put up the container's sign of life, and tell everybody whatever is announced from now on.

        Raises:
            ChannelClosed: the transport was closed.
        """
        self._shown = True
        return self._transport.appear(alive_key(self._own))

    def announce(self, domain: str, provider: str, info: ProviderInfo) -> None:
        """Tell everybody of a provider, or that it is gone if it has no services.

        Raises:
            ChannelClosed: the transport was closed.
        """
        key, payload = registry_key(domain, self._own, provider), encode_message(info)
        with self._lock:
            self._revision, self._quiet = info.revision, 0
            if info.services:
                self._standing[key] = payload
            else:
                self._standing.pop(key, None)
        if self._shown:
            self._transport.announce(key, payload)

    def beat(self) -> None:
        """Say how far it is if it is time for that, for those who missed the last thing that was announced.

        That is at the first beat after it, the second, the fourth and so on, and then at every eighth (`SELDOM`): as
        all hear all others, what is said for nothing grows with the square of how many there are.

        Raises:
            ChannelClosed: the transport was closed.
        """
        with self._lock:
            self._quiet += 1
            quiet, revision = self._quiet, self._revision
        if quiet % SELDOM == 0 or (quiet < SELDOM and quiet.bit_count() == 1):
            self._transport.announce(tally_key(self._own), encode_message(Tally(PROTOCOL, revision)))

    def _answer_all(self) -> None:
        while True:
            try:
                question = self._questions.receive()
            except ChannelClosed:
                return
            try:
                self._answer(question)
            except ChannelClosed:  # who asked is gone
                continue
            except Exception:
                _logger.exception("a question for what stands could not be answered")
            finally:
                question.close()

    def _answer(self, question: Question) -> None:
        with self._lock:
            standing, revision = list(self._standing.items()), self._revision
        for key, payload in standing:
            question.answer(key, payload)
        question.answer(tally_key(self._own), encode_message(Tally(PROTOCOL, revision)))

    def close(self) -> None:
        """Answer nobody any more. Idempotent."""
        self._questions.close()
        if self._thread is not threading.current_thread():
            self._thread.join(2)
