"""What this container announces: told at once, kept for those who ask, and counted so that nobody misses any of it."""

import logging
import threading

from trade._transport import ChannelClosed, Question, Transport
from trade._wire import PROTOCOL, Address, ProviderInfo, Tally, encode_message, registry_key, tally_key

_logger = logging.getLogger("trade")


class Announcer:
    """Owns what stands. One at a time announces; a thread of its own answers who asks.

    The revision of each announcement is one more than that of the one before, whatever it is about: who finds one
    missing asks.
    """

    def __init__(self, transport: Transport, own: Address) -> None:
        self._transport = transport
        self._own = own
        self._lock = threading.Lock()
        self._standing: dict[str, bytes] = {}
        self._revision = 0
        self._questions = transport.questions(registry_key("*", own, "*"))
        self._thread = threading.Thread(target=self._answer_all, name="trade-answers", daemon=True)
        self._thread.start()

    def announce(self, domain: str, provider: str, info: ProviderInfo) -> None:
        """Tell everybody of a provider, or that it is gone if it has no services.

        Raises:
            ChannelClosed: the transport was closed.
        """
        key, payload = registry_key(domain, self._own, provider), encode_message(info)
        with self._lock:
            self._revision = info.revision
            if info.services:
                self._standing[key] = payload
            else:
                self._standing.pop(key, None)
        self._transport.announce(key, payload)

    def beat(self) -> None:
        """Say how far it is, for those who missed the last thing that was announced.

        Raises:
            ChannelClosed: the transport was closed.
        """
        self._transport.announce(tally_key(self._own), encode_message(Tally(PROTOCOL, self._revision)))

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
