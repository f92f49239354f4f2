"""What every transport must do: the guarantees of ``_transport``, each a test of its own."""

# ruff: noqa: S101 - these are tests

import contextlib
import os
import signal
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager

from trade._transport import Channel, ChannelClosed, Message, Publisher, Transport
from trade.testing._ear import PATIENCE_S, Ear

__all__ = ["TransportConformance"]

_BIG_BYTES = 8 * 1024 * 1024


class TransportConformance(ABC):
    """The guarantees of a transport. Subclass it under a name that pytest collects and say how a network is made.

    Example::

        class TestMyTransport(TransportConformance):
            @contextlib.contextmanager
            def network(self):
                hub = MyHub()
                yield lambda: MyTransport(hub)
                hub.close()
    """

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

    # --- messages

    def test_what_is_put_is_heard_by_the_others(self) -> None:
        with self.pair() as (one, other):
            ear = _listen(other, "room/a", speaker=one)
            one.publish("room/a").put(b"hello")
            assert ear.next() == Message("room/a", b"hello")

    def test_a_transport_hears_what_it_puts_itself(self) -> None:
        with self.pair() as (one, _):
            ear = Ear(one.subscribe("room/a"))
            one.publish("room/a").put(b"hello")
            assert ear.next() == Message("room/a", b"hello")

    def test_messages_of_one_publisher_arrive_in_order(self) -> None:
        with self.pair() as (one, other):
            ear = _listen(other, "room/a", speaker=one)
            publisher = one.publish("room/a")
            numbers = [str(number).encode() for number in range(2000)]
            for number in numbers:
                publisher.put(number)
            assert [ear.next().payload for _ in numbers] == numbers

    def test_what_is_subscribed_before_an_announcement_hears_all_that_follows_it(self) -> None:
        with self.pair() as (one, other):
            announced = Ear(one.announcements("here/**"))
            for turn in range(50):
                ear = Ear(other.subscribe(f"room/{turn}"))
                _here = _announce(other, f"here/{turn}", b"1")
                announced.until(f"here/{turn}", b"1")
                one.publish(f"room/{turn}").put(b"first")
                assert ear.next().payload == b"first"

    def test_a_star_stands_for_one_chunk_and_two_for_any_number(self) -> None:
        keys = ["room", "room/a", "room/a/b", "room/a/b/c", "other/a", "room/x/b"]
        fits = {
            "room/a": {"room/a"},
            "room/*": {"room/a"},
            "room/**": {"room", "room/a", "room/a/b", "room/a/b/c", "room/x/b"},
            "room/*/b": {"room/a/b", "room/x/b"},
            "room/*/**": {"room/a", "room/a/b", "room/a/b/c", "room/x/b"},
            "room/**/b": {"room/a/b", "room/x/b"},
            "*/a": {"room/a", "other/a"},
        }
        with self.pair() as (one, other):
            for pattern, fitting in fits.items():
                ear = _listen(other, pattern, speaker=one)
                for key in sorted(keys, key=fitting.__contains__):  # those that must not be heard first
                    one.publish(key).put(b"")
                assert {ear.next().key for _ in fitting} == fitting, pattern
                ear.channel.close()

    def test_several_readers_of_one_channel_share_its_messages(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.subscribe("room/a"), readers=4)
            _meet(listener=other, speaker=one)
            publisher, numbers = one.publish("room/a"), {str(number).encode() for number in range(200)}
            for number in numbers:
                publisher.put(number)
            assert {ear.next().payload for _ in numbers} == numbers
            publisher.put(b"end")
            assert ear.next().payload == b"end"

    def test_every_channel_of_a_pattern_gets_every_message(self) -> None:
        with self.pair() as (one, other):
            ears = [Ear(other.subscribe("room/**")) for _ in range(3)]
            _meet(listener=other, speaker=one)
            one.publish("room/a").put(b"all")
            assert [ear.next().payload for ear in ears] == [b"all"] * 3

    def test_nothing_is_kept_of_plain_messages(self) -> None:
        with self.pair() as (one, other):
            early = _listen(other, "room/**", speaker=one)
            publisher = one.publish("room/a")
            publisher.put(b"early")
            assert early.next().payload == b"early"
            late = _listen(other, "room/a", speaker=one)
            publisher.put(b"late")
            assert late.next().payload == b"late"

    def test_an_empty_payload_is_a_message_like_others(self) -> None:
        with self.pair() as (one, other):
            ear = _listen(other, "room/a", speaker=one)
            one.publish("room/a").put(b"")
            assert ear.next() == Message("room/a", b"")

    def test_eight_mebibytes_arrive_unharmed(self) -> None:
        payload = os.urandom(_BIG_BYTES)
        with self.pair() as (one, other):
            ear = _listen(other, "room/a", speaker=one)
            one.publish("room/a").put(payload)
            assert ear.next().payload == payload

    def test_urgent_messages_arrive_while_others_never_cease(self) -> None:
        with self.pair() as (one, other):
            bulk, urgent = Ear(other.subscribe("bulk")), Ear(other.subscribe("urgent"))
            _meet(listener=other, speaker=one)
            with _flood(one, "bulk", bytes(256 * 1024)):
                assert bulk.next()
                stop = one.publish("urgent", urgent=True)
                for _ in range(20):
                    stop.put(b"stop")
                    assert urgent.next().payload == b"stop"

    # --- announcements

    def test_an_announcement_its_changes_and_its_withdrawal_are_heard(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.announcements("shop/**"))
            announcement = _announce(one, "shop/bread", b"fresh")
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
            _meet(listener=one, speaker=other)
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
            _milk = _announce(one, "shop/milk", b"cold")
            assert ear.next() == Message("shop/milk", b"cold")
            assert late.standing("shop/**", PATIENCE_S) == [Message("shop/milk", b"cold")]

    def test_what_was_withdrawn_can_be_announced_again(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.announcements("shop/**"))
            for value in (b"old", b"new"):
                announcement = _announce(one, "shop/bread", value)
                assert ear.next() == Message("shop/bread", value)
                announcement.close()
                assert ear.next() == Message("shop/bread", None)

    def test_who_hears_of_an_announcement_hears_of_its_withdrawal_however_soon(self) -> None:
        with self.pair() as (one, other):
            for turn in range(200):
                ear, last = Ear(other.announcements(f"shop-{turn}/**")), dict[str, bytes | None]()
                for number in range(2):
                    _announce(one, f"shop-{turn}/{number}", b"gone soon").close()
                stays = _announce(one, f"shop-{turn}/end", b"stays")
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
            _kept = _announce(one, "shop/own", b"1"), _announce(other, "shop/other", b"1")
            assert ear.next() == Message("shop/other", b"1")

    def test_announcements_that_stand_can_be_asked_for(self) -> None:
        with self.network() as open_transport:
            one, other = open_transport(), open_transport()
            bread = one.announce("shop/bread")
            bread.put(b"old")
            bread.put(b"fresh")
            _kept = _announce(other, "shop/milk", b"cold"), _announce(other, "bank/money", b"1")
            late = open_transport()
            standing = sorted((message.key, message.payload) for message in late.standing("shop/**", PATIENCE_S))
            assert standing == [("shop/bread", b"fresh"), ("shop/milk", b"cold")]

    def test_announcements_of_ones_own_stand_too(self) -> None:
        with self.pair() as (one, _):
            _bread = _announce(one, "shop/bread", b"fresh")
            assert one.standing("shop/**", PATIENCE_S) == [Message("shop/bread", b"fresh")]

    def test_an_announcement_without_a_value_does_not_stand(self) -> None:
        with self.pair() as (one, other):
            _kept = one.announce("shop/bread"), _announce(one, "shop/milk", b"cold")
            _meet(listener=one, speaker=other)
            assert other.standing("shop/**", PATIENCE_S) == [Message("shop/milk", b"cold")]

    def test_announcements_go_with_their_transport(self) -> None:
        with self.pair() as (one, other):
            ear = Ear(other.presences("alive/**"))
            _kept = one.appear("alive/one"), _announce(one, "shop/bread", b"fresh")
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

    # --- waking

    def test_waking_reaches_the_readers_of_the_same_transport_and_nobody_else(self) -> None:
        with self.pair() as (one, other):
            own, far = Ear(one.subscribe("room/*")), _listen(other, "room/*", speaker=one)
            one.wake("room/a", b"wake")
            assert own.next() == Message("room/a", b"wake")
            one.publish("room/a").put(b"put")
            assert far.next() == Message("room/a", b"put")

    # --- ends

    def test_closing_a_channel_ends_every_reader(self) -> None:
        with self.pair() as (one, _):
            for channel in _channels(one):
                ear = Ear(channel, readers=3)
                channel.close()
                channel.close()
                assert ear.ends()

    def test_closing_a_channel_leaves_the_others_alone(self) -> None:
        with self.pair() as (one, other):
            ear = _listen(other, "room/a", speaker=one)
            other.subscribe("room/a").close()
            one.publish("room/a").put(b"on")
            assert ear.next().payload == b"on"

    def test_closing_a_transport_ends_all_its_channels(self) -> None:
        with self.pair() as (one, _):
            ears = [Ear(channel, readers=2) for channel in _channels(one)]
            one.close()
            one.close()
            assert all(ear.ends() for ear in ears)

    def test_a_closed_publisher_puts_nothing(self) -> None:
        with self.pair() as (one, _):
            for publisher in (one.publish("room/a"), one.publish("room/a", urgent=True), one.announce("room/b")):
                publisher.close()
                publisher.close()
                assert _refuses(lambda publisher=publisher: publisher.put(b"late"))

    def test_publishers_and_signs_of_a_closed_transport_can_be_closed(self) -> None:
        with self.pair() as (one, _):
            publishers, sign = [one.publish("room/a"), one.announce("room/b")], one.appear("alive/one")
            channels = _channels(one)
            one.close()
            assert all(_refuses(lambda publisher=publisher: publisher.put(b"late")) for publisher in publishers)
            for thing in (*publishers, sign, *channels):
                thing.close()

    def test_a_closed_transport_refuses_every_verb(self) -> None:
        verbs: dict[str, Callable[[Transport], object]] = {
            "publish": lambda closed: closed.publish("room/a"),
            "subscribe": lambda closed: closed.subscribe("room/a"),
            "announce": lambda closed: closed.announce("room/a"),
            "announcements": lambda closed: closed.announcements("room/**"),
            "standing": lambda closed: closed.standing("room/**", 1.0),
            "appear": lambda closed: closed.appear("alive/one"),
            "presences": lambda closed: closed.presences("alive/**"),
            "present": lambda closed: closed.present("alive/**", 1.0),
        }
        with self.pair() as (one, _):
            one.close()
            for name, verb in verbs.items():
                assert _refuses(lambda verb=verb: verb(one)), name

    def test_waking_a_closed_transport_does_nothing(self) -> None:
        with self.pair() as (one, _):
            one.close()
            one.wake("room/a", b"")

    def test_what_remains_goes_on_without_the_one_that_closed(self) -> None:
        with self.network() as open_transport:
            one, other, third = open_transport(), open_transport(), open_transport()
            ear = _listen(other, "room/a", speaker=third)
            one.close()
            third.publish("room/a").put(b"on")
            assert ear.next().payload == b"on"

    def test_an_interrupt_reaches_a_thread_that_waits(self) -> None:
        if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
            return
        with self.pair() as (one, _):
            channel, interrupted = one.subscribe("room/a"), False
            timer = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
            timer.start()
            try:
                channel.receive()
            except KeyboardInterrupt:
                interrupted = True
            timer.join()
            assert interrupted


def _listen(listener: Transport, pattern: str, *, speaker: Transport) -> Ear:
    """Subscribe, and wait until the speaker knows."""
    ear = Ear(listener.subscribe(pattern))
    _meet(listener=listener, speaker=speaker)
    return ear


def _meet(*, listener: Transport, speaker: Transport) -> None:
    """What the listener has subscribed, the speaker reaches from now on: it hears an announcement made after it."""
    ear = Ear(speaker.announcements("meeting/**"))
    announcement = listener.announce("meeting/point")
    announcement.put(b"here")
    ear.until("meeting/point", b"here")
    announcement.close()
    ear.channel.close()
    assert ear.ends()


def _announce(transport: Transport, key: str, payload: bytes) -> Publisher:
    """An announcement with a value; it stands while it is kept."""
    announcement = transport.announce(key)
    announcement.put(payload)
    return announcement


def _channels(transport: Transport) -> list[Channel]:
    return [transport.subscribe("room/**"), transport.announcements("shop/**"), transport.presences("alive/**")]


def _refuses(action: Callable[[], object]) -> bool:
    try:
        action()
    except ChannelClosed:
        return True
    return False


@contextlib.contextmanager
def _flood(transport: Transport, key: str, payload: bytes) -> Generator[None, None, None]:
    """Put without a pause from another thread."""
    done, publisher = threading.Event(), transport.publish(key)

    def put() -> None:
        while not done.is_set():
            publisher.put(payload)

    thread = threading.Thread(target=put, name="flood")
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
