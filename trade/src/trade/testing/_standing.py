"""What every transport must do with what stands: announcements and signs of life."""

# ruff: noqa: S101 - these are tests

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager

from trade._transport import Message, Transport
from trade.testing._ear import PATIENCE_S, Ear, announce, meet


class StandingConformance(ABC):
    """The part of `TransportConformance` that is about what stands."""

    @abstractmethod
    def network(self) -> AbstractContextManager[Callable[[], Transport]]:
        """An empty network; it is closed with all its transports at the end.

        Returns:
            A context manager that gives a function. Each call of that opens one more transport and returns when it is
            linked with those opened before.
        """

    @contextlib.contextmanager
    def pair(self) -> Generator[tuple[Transport, Transport], None, None]:
        """Two transports of one network."""
        with self.network() as open_transport:
            yield open_transport(), open_transport()

    # --- announcements

    def test_an_announcement_its_changes_and_its_withdrawal_are_heard(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.announcements("shop/**"))
            announcement = announce(one, "shop/bread", b"fresh")
            assert ear.next() == Message("shop/bread", b"fresh")
            announcement.put(b"dry")
            announcement.put(b"sold out")
            announcement.close()
            assert [ear.next().payload for _ in range(3)] == [b"dry", b"sold out", None]

    def test_who_comes_later_hears_the_last_value_only(self) -> None:
        with self.network() as open_transport:
            one = open_transport()
            announcement = one.announce("shop/bread")
            for value in (b"1", b"2", b"3"):
                announcement.put(value)
            ear = Ear(open_transport().announcements("shop/**"))
            assert ear.next() == Message("shop/bread", b"3")
            announcement.put(b"4")
            assert ear.next() == Message("shop/bread", b"4")

    def test_who_listens_later_hears_the_last_value_only(self) -> None:
        with self.pair() as (one, other):
            announcement = one.announce("shop/bread")
            for value in (b"1", b"2", b"3"):
                announcement.put(value)
            meet(listener=one, speaker=other)
            ear = Ear(other.announcements("shop/**"))
            assert ear.next().payload == b"3"

    def test_who_comes_after_a_withdrawal_hears_nothing_of_it(self) -> None:
        with self.network() as open_transport:
            one = open_transport()
            announcement = one.announce("shop/bread")
            announcement.put(b"fresh")
            announcement.close()
            late = open_transport()
            ear = Ear(late.announcements("shop/**"))
            _milk = announce(one, "shop/milk", b"cold")
            assert ear.next() == Message("shop/milk", b"cold")
            assert late.standing("shop/**", PATIENCE_S) == [Message("shop/milk", b"cold")]

    def test_what_was_withdrawn_can_be_announced_again(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.announcements("shop/**"))
            for value in (b"old", b"new"):
                announcement = announce(one, "shop/bread", value)
                assert ear.next() == Message("shop/bread", value)
                announcement.close()
                assert ear.next() == Message("shop/bread", None)

    def test_who_hears_of_an_announcement_hears_of_its_withdrawal_however_soon(self) -> None:
        with self.pair() as (one, other):
            for turn in range(200):
                ear, last = Ear(other.announcements(f"shop-{turn}/**")), dict[str, bytes | None]()
                for number in range(2):
                    announce(one, f"shop-{turn}/{number}", b"gone soon").close()
                stays = announce(one, f"shop-{turn}/end", b"stays")
                for message in ear.until(f"shop-{turn}/end", b"stays"):
                    last[message.key] = message.payload
                while not set(last.values()) <= {None}:  # announcements are in order each, not among each other
                    message = ear.next()
                    last[message.key] = message.payload
                ear.channel.close()
                stays.close()

    def test_an_announcement_has_a_value(self) -> None:
        with self.pair() as (one, _):
            announcement, refused = one.announce("shop/bread"), False
            try:
                announcement.put(b"")
            except ValueError:
                refused = True
            assert refused

    def test_nobody_hears_announcements_of_their_own(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(one.announcements("shop/**"))
            _kept = announce(one, "shop/own", b"1"), announce(other, "shop/other", b"1")
            assert ear.next() == Message("shop/other", b"1")

    def test_announcements_that_stand_can_be_asked_for(self) -> None:
        with self.network() as open_transport:
            one, other = open_transport(), open_transport()
            bread = one.announce("shop/bread")
            bread.put(b"old")
            bread.put(b"fresh")
            _kept = announce(other, "shop/milk", b"cold"), announce(other, "bank/money", b"1")
            late = open_transport()
            standing = sorted((message.key, message.payload) for message in late.standing("shop/**", PATIENCE_S))
            assert standing == [("shop/bread", b"fresh"), ("shop/milk", b"cold")]

    def test_announcements_of_ones_own_stand_too(self) -> None:
        with self.pair() as (one, _):
            _bread = announce(one, "shop/bread", b"fresh")
            assert one.standing("shop/**", PATIENCE_S) == [Message("shop/bread", b"fresh")]

    def test_an_announcement_without_a_value_does_not_stand(self) -> None:
        with self.pair() as (one, other):
            _kept = one.announce("shop/bread"), announce(one, "shop/milk", b"cold")
            meet(listener=one, speaker=other)
            assert other.standing("shop/**", PATIENCE_S) == [Message("shop/milk", b"cold")]

    def test_announcements_go_with_their_transport(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.presences("alive/**"))
            _kept = one.appear("alive/one"), announce(one, "shop/bread", b"fresh")
            assert ear.next() == Message("alive/one", b"")
            one.close()
            assert ear.next() == Message("alive/one", None)
            assert other.standing("shop/**", PATIENCE_S) == []

    # --- presence

    def test_a_sign_of_life_rises_falls_and_returns(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.presences("alive/**"))
            for _ in range(3):
                sign = one.appear("alive/one")
                assert ear.next() == Message("alive/one", b"")
                sign.close()
                assert ear.next() == Message("alive/one", None)

    def test_signs_of_life_fall_when_their_transport_closes(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.presences("alive/**"))
            _kept = one.appear("alive/a"), one.appear("alive/b")
            assert {ear.next().key for _ in range(2)} == {"alive/a", "alive/b"}
            one.close()
            falls = {(message.key, message.payload) for message in (ear.next(), ear.next())}
            assert falls == {("alive/a", None), ("alive/b", None)}

    def test_signs_of_life_that_stand_are_heard_first(self) -> None:
        with self.network() as open_transport:
            one = open_transport()
            _kept = one.appear("alive/a"), one.appear("alive/b")
            ear = Ear(open_transport().presences("alive/**"))
            assert {ear.next() for _ in range(2)} == {Message("alive/a", b""), Message("alive/b", b"")}
            _more = one.appear("alive/c")
            assert ear.next() == Message("alive/c", b"")

    def test_signs_of_life_of_ones_own_are_heard_too(self) -> None:
        with self.pair() as (one, _):
            ear = Ear(one.presences("alive/**"))
            sign = one.appear("alive/one")
            assert ear.next() == Message("alive/one", b"")
            assert one.present("alive/**", PATIENCE_S) == ["alive/one"]
            sign.close()
            assert ear.next() == Message("alive/one", None)

    def test_signs_of_life_that_stand_can_be_asked_for(self) -> None:
        with self.network() as open_transport:
            one, other = open_transport(), open_transport()
            _kept = one.appear("alive/one"), other.appear("alive/other"), one.appear("dead/one")
            one.appear("alive/gone").close()
            assert sorted(open_transport().present("alive/*", PATIENCE_S)) == ["alive/one", "alive/other"]
