"""Conformance of transports: losing another transport and finding it again."""

# ruff: noqa: S101 - these are tests

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import NamedTuple

from trade.testing._ear import PATIENCE_S, RecordingListener, RegistryResponder, meet
from trade.transport.base import Message, Transport


class Severable(NamedTuple):
    """Two transports and the link between them."""

    one: Transport
    other: Transport
    sever: Callable[[], None]
    """Disconnect them: when this returns or soon after, signs of life disappear on both sides."""
    reconnect: Callable[[], None]
    """Reconnect them, within some time after this returns."""


class LossConformance(ABC):
    """The guarantees when transports lose each other and come back, both alive throughout.

    Subclass it under a name that pytest collects and define how to create such a pair.
    """

    @abstractmethod
    def severable(self) -> AbstractContextManager[Severable]:
        """Two linked transports, closed at the end."""

    def test_signs_of_life_fall_on_both_sides_and_rise_again(self) -> None:
        with self.severable() as (one, other, sever, reconnect):
            _signs = one.appear("alive/one"), other.appear("alive/other")
            far = RecordingListener(one.presences("alive/other")), RecordingListener(other.presences("alive/one"))
            assert [ear.next().payload for ear in far] == [b"", b""]
            sever()
            assert [ear.next().payload for ear in far] == [None, None]
            assert one.present("alive/**", PATIENCE_S) == ["alive/one"]
            reconnect()
            assert [ear.next().payload for ear in far] == [b"", b""]

    def test_once_a_liveliness_token_is_back_all_current_entries_are_sent_on_request(self) -> None:
        with self.severable() as (one, other, sever, reconnect):
            standing = {f"shop/{number}": b"1" for number in range(50)}
            RegistryResponder(one, "shop/*", standing)
            lost = _LostPeer(one, other, sever)
            del standing["shop/49"]
            reconnect()
            assert lost.returns()
            [answer] = other.ask(["shop/**"], PATIENCE_S)
            assert answer.messages == [Message(f"shop/{number}", b"1") for number in range(49)]

    def test_who_is_lost_amid_a_question_is_not_waited_for(self) -> None:
        with self.severable() as (one, other, sever, _reconnect):
            questions = one.questions("shop/*")
            meet(listener=one, speaker=other)
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(other.ask, ["shop/*"], 3600.0)
                question = questions.receive()
                sever()
                assert asked.result(2 * PATIENCE_S) == []
            question.close()

    def test_once_a_sign_has_risen_again_announcements_are_heard_as_before(self) -> None:
        with self.severable() as (one, other, sever, reconnect):
            ear = RecordingListener(other.announcements("shop/**"))
            lost = _LostPeer(one, other, sever)
            one.announce("shop/bread", b"missed")
            reconnect()
            assert lost.returns()
            meet(listener=other, speaker=one)
            one.announce("shop/bread", b"heard")
            assert ear.next() == Message("shop/bread", b"heard")

    def test_once_a_sign_has_risen_again_messages_arrive_as_before(self) -> None:
        with self.severable() as (one, other, sever, reconnect):
            ear, publisher = RecordingListener(one.subscribe("room/a")), other.publish("room/a")
            lost = _LostPeer(one, other, sever)
            reconnect()
            assert lost.returns()
            publisher.put(b"after")
            assert ear.next() == Message("room/a", b"after")


class _LostPeer:
    """The first of two transports, lost to the second; knows when it is back."""

    def __init__(self, one: Transport, other: Transport, sever: Callable[[], None]) -> None:
        self._ear = RecordingListener(other.presences("alive/one"))
        self._sign = one.appear("alive/one")
        assert self._ear.next().payload == b""
        sever()
        assert self._ear.next().payload is None

    def returns(self) -> bool:
        return self._ear.next().payload == b""
