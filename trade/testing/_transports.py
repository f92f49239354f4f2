"""Conformance of transports: the guarantees of `trade.transport.base`, each with its own test."""

# ruff: noqa: S101 - these are tests

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator

from trade.testing._ear import RecordingListener, listen, meet
from trade.testing._standing import StandingConformance
from trade.transport.base import Channel, ChannelClosed, Message, Transport

_BIG_BYTES = 8 * 1024 * 1024


class TransportConformance(StandingConformance):
    """The guarantees of a transport. Subclass it under a name that pytest collects and define how to create a network.

    Example::

        class TestMyTransport(TransportConformance):
            @contextlib.contextmanager
            def network(self):
                hub = MyHub()
                yield lambda: MyTransport(hub)
                hub.close()
    """

    # --- messages

    def test_what_is_put_is_heard_by_the_others(self) -> None:
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            one.publish("room/a").put(b"hello")
            assert ear.next() == Message("room/a", b"hello")

    def test_a_transport_hears_what_it_puts_itself(self) -> None:
        with self.pair() as (one, _):
            ear = RecordingListener(one.subscribe("room/a"))
            one.publish("room/a").put(b"hello")
            assert ear.next() == Message("room/a", b"hello")

    def test_messages_of_one_publisher_arrive_in_order(self) -> None:
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            publisher = one.publish("room/a")
            numbers = [str(number).encode() for number in range(2000)]
            for number in numbers:
                publisher.put(number)
            assert [ear.next().payload for _ in numbers] == numbers

    def test_what_is_subscribed_before_an_announcement_hears_all_that_follows_it(self) -> None:
        with self.pair() as (one, other):
            announced = RecordingListener(one.announcements("here/**"))
            meet(listener=one, speaker=other)
            for turn in range(50):
                ear = RecordingListener(other.subscribe(f"room/{turn}"))
                other.announce(f"here/{turn}", b"1")
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
                ear = listen(other, pattern, speaker=one)
                for key in sorted(keys, key=fitting.__contains__):  # those that must not be received first
                    one.publish(key).put(b"")
                assert {ear.next().key for _ in fitting} == fitting, pattern
                ear.channel.close()

    def test_several_readers_of_one_channel_share_its_messages(self) -> None:
        with self.pair() as (one, other):
            ear = RecordingListener(other.subscribe("room/a"), readers=4)
            meet(listener=other, speaker=one)
            publisher, numbers = one.publish("room/a"), {str(number).encode() for number in range(200)}
            for number in numbers:
                publisher.put(number)
            assert {ear.next().payload for _ in numbers} == numbers
            publisher.put(b"end")
            assert ear.next().payload == b"end"

    def test_every_channel_of_a_pattern_gets_every_message(self) -> None:
        with self.pair() as (one, other):
            ears = [RecordingListener(other.subscribe("room/**")) for _ in range(3)]
            meet(listener=other, speaker=one)
            one.publish("room/a").put(b"all")
            assert [ear.next().payload for ear in ears] == [b"all"] * 3

    def test_nothing_is_kept_of_plain_messages(self) -> None:
        with self.pair() as (one, other):
            early = listen(other, "room/**", speaker=one)
            publisher = one.publish("room/a")
            publisher.put(b"early")
            assert early.next().payload == b"early"
            late = listen(other, "room/a", speaker=one)
            publisher.put(b"late")
            assert late.next().payload == b"late"

    def test_an_empty_payload_is_a_message_like_others(self) -> None:
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            one.publish("room/a").put(b"")
            assert ear.next() == Message("room/a", b"")

    def test_eight_mebibytes_arrive_unharmed(self) -> None:
        payload = os.urandom(_BIG_BYTES)
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            one.publish("room/a").put(payload)
            assert ear.next().payload == payload

    def test_urgent_messages_arrive_while_others_never_cease(self) -> None:
        with self.pair() as (one, other):
            bulk, urgent = RecordingListener(other.subscribe("bulk")), RecordingListener(other.subscribe("urgent"))
            meet(listener=other, speaker=one)
            with _flood(one, "bulk", bytes(256 * 1024)):
                assert bulk.next()
                stop = one.publish("urgent", urgent=True)
                for _ in range(20):
                    stop.put(b"stop")
                    assert urgent.next().payload == b"stop"

    def test_droppable_messages_arrive_in_order_if_no_reader_stalls(self) -> None:
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            publisher = one.publish("room/a", urgent=True, droppable=True)
            numbers = [str(number).encode() for number in range(100)]
            for number in numbers:  # one at a time: of two at once one may be dropped
                publisher.put(number)
                assert ear.next().payload == number

    def test_droppable_messages_that_are_not_urgent_arrive_in_order_if_no_reader_stalls(self) -> None:
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            publisher = one.publish("room/a", droppable=True)
            for number in range(50):
                publisher.put(str(number).encode())
                assert ear.next().payload == str(number).encode()

    def test_a_reader_that_keeps_the_newest_delays_no_sender_and_loses_the_oldest(self) -> None:
        with self.pair() as (one, other):
            newest = other.subscribe("room/a", newest=4)
            every = listen(other, "room/*", speaker=one)
            publisher = one.publish("room/a")
            for number in range(100):
                publisher.put(str(number).encode())
            one.publish("room/b").put(b"all")  # behind them
            every.until("room/b", b"all")
            assert [newest.receive().payload for _ in range(4)] == [b"96", b"97", b"98", b"99"]

    # --- waking

    def test_waking_reaches_the_readers_of_the_same_transport_only(self) -> None:
        with self.pair() as (one, other):
            own, far = RecordingListener(one.subscribe("room/*")), listen(other, "room/*", speaker=one)
            one.wake("room/a", b"wake")
            assert own.next() == Message("room/a", b"wake")
            one.publish("room/a").put(b"put")
            assert far.next() == Message("room/a", b"put")

    # --- ends

    def test_closing_a_channel_ends_every_reader(self) -> None:
        with self.pair() as (one, _):
            for channel in _channels(one):
                ear = RecordingListener(channel, readers=3)
                channel.close()
                channel.close()
                assert ear.ends()

    def test_closing_a_channel_leaves_the_others_alone(self) -> None:
        with self.pair() as (one, other):
            ear = listen(other, "room/a", speaker=one)
            other.subscribe("room/a").close()
            one.publish("room/a").put(b"on")
            assert ear.next().payload == b"on"

    def test_closing_a_transport_ends_all_its_channels(self) -> None:
        with self.pair() as (one, _):
            ears = [RecordingListener(channel, readers=2) for channel in _channels(one)]
            one.close()
            one.close()
            assert all(ear.ends() for ear in ears)

    def test_a_closed_publisher_puts_nothing(self) -> None:
        with self.pair() as (one, _):
            for publisher in (one.publish("room/a"), one.publish("room/a", urgent=True, droppable=True)):
                publisher.close()
                publisher.close()
                assert _refuses(lambda publisher=publisher: publisher.put(b"late"))

    def test_publishers_and_signs_of_a_closed_transport_can_be_closed(self) -> None:
        with self.pair() as (one, _):
            publishers, sign = [one.publish("room/a"), one.publish("room/b", urgent=True)], one.appear("alive/one")
            channels, questions = _channels(one), one.questions("shop/**")
            one.close()
            assert all(_refuses(lambda publisher=publisher: publisher.put(b"late")) for publisher in publishers)
            for thing in (*publishers, sign, *channels, questions):
                thing.close()

    def test_a_closed_transport_refuses_every_verb(self) -> None:
        verbs: dict[str, Callable[[Transport], object]] = {
            "publish": lambda closed: closed.publish("room/a"),
            "subscribe": lambda closed: closed.subscribe("room/a"),
            "announce": lambda closed: closed.announce("room/a", b"1"),
            "announcements": lambda closed: closed.announcements("room/**"),
            "questions": lambda closed: closed.questions("room/**"),
            "ask": lambda closed: closed.ask(["room/**"], 1.0),
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

    def test_the_others_continue_without_the_one_that_closed(self) -> None:
        with self.network() as open_transport:
            one, other, third = open_transport(), open_transport(), open_transport()
            ear = listen(other, "room/a", speaker=third)
            one.close()
            third.publish("room/a").put(b"on")
            assert ear.next().payload == b"on"

    def test_an_interrupt_reaches_a_thread_that_waits(self) -> None:
        if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
            return
        with self.pair() as (one, _):
            channel, interrupted = one.subscribe("room/a"), False
            timer = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
            before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
            try:
                timer.start()
                channel.receive()
            except KeyboardInterrupt:
                interrupted = True
            finally:
                timer.join()
                signal.signal(signal.SIGINT, before)
            assert interrupted


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
    """Publish without a pause from another thread."""
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
