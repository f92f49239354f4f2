"""What every transport must do when it loses another one and finds it again."""

# ruff: noqa: S101 - these are tests

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

from trade._transport import Message, Transport
from trade.testing._ear import PATIENCE_S, Ear

__all__ = ["LossConformance", "Severable"]


class Severable(NamedTuple):
    """Two transports and what lies between them."""

    one: Transport
    other: Transport
    sever: Callable[[], None]
    """Let them lose each other: when this returns or soon after, signs of life fall on both sides."""
    mend: Callable[[], None]
    """Let them find each other again, some time after this returns."""


class LossConformance(ABC):
    """What holds when transports lose each other and come back, both alive all the time.

    Subclass it under a name that pytest collects and say how such a pair is made.
    """

    @abstractmethod
    def severable(self) -> AbstractContextManager[Severable]:
        """Two linked transports, closed at the end."""

    def test_signs_of_life_fall_on_both_sides_and_rise_again(self) -> None:
        with self.severable() as (one, other, sever, mend):
            _signs = one.appear("alive/one"), other.appear("alive/other")
            far = Ear(one.presences("alive/other")), Ear(other.presences("alive/one"))
            assert [ear.next().payload for ear in far] == [b"", b""]
            sever()
            assert [ear.next().payload for ear in far] == [None, None]
            assert one.present("alive/**", PATIENCE_S) == ["alive/one"]
            mend()
            assert [ear.next().payload for ear in far] == [b"", b""]

    def test_what_was_announced_meanwhile_is_told_and_what_is_known_is_not_repeated(self) -> None:
        with self.severable() as (one, other, sever, mend):
            announcements = {name: one.announce(f"shop/{name}") for name in ("bread", "milk")}
            ear = Ear(other.announcements("shop/**"))
            for announcement in announcements.values():
                announcement.put(b"1")
            assert {ear.next().key for _ in range(2)} == {"shop/bread", "shop/milk"}
            lost = _Lost(one, other, sever)
            announcements["bread"].put(b"2")
            announcements["bread"].put(b"3")
            cheese = one.announce("shop/cheese")
            cheese.put(b"1")
            mend()
            assert lost.returns()
            assert {ear.next() for _ in range(2)} == {Message("shop/bread", b"3"), Message("shop/cheese", b"1")}
            announcements["milk"].put(b"2")
            assert ear.next() == Message("shop/milk", b"2")

    def test_once_a_sign_has_risen_again_all_that_stands_is_told_when_asked(self) -> None:
        with self.severable() as (one, other, sever, mend):
            announcements = [one.announce(f"shop/{number}") for number in range(50)]
            for announcement in announcements:
                announcement.put(b"1")
            lost = _Lost(one, other, sever)
            announcements.pop().close()
            mend()
            assert lost.returns()
            standing = {message.key for message in other.standing("shop/**", PATIENCE_S)}
            assert standing == {f"shop/{number}" for number in range(49)}

    def test_once_a_sign_has_risen_again_messages_arrive_as_before(self) -> None:
        with self.severable() as (one, other, sever, mend):
            ear, publisher = Ear(one.subscribe("room/a")), other.publish("room/a")
            lost = _Lost(one, other, sever)
            mend()
            assert lost.returns()
            publisher.put(b"after")
            assert ear.next() == Message("room/a", b"after")


class _Lost:
    """The first of two, lost to the second; knows when it is back."""

    def __init__(self, one: Transport, other: Transport, sever: Callable[[], None]) -> None:
        self._ear = Ear(other.presences("alive/one"))
        self._sign = one.appear("alive/one")
        assert self._ear.next().payload == b""
        sever()
        assert self._ear.next().payload is None

    def returns(self) -> bool:
        return self._ear.next().payload == b""
