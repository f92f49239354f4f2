"""Frames on a socket: nothing is lost but what may be dropped, and of that the newest stays."""

import socket
import struct
import threading
from collections.abc import Iterator

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from trade_gateway.ros.ros1._node import _frames
from trade_gateway.ros.ros1._node._frames import Channel, Head

Pair = tuple[Channel, Channel]


@pytest.fixture
def pair() -> Iterator[Pair]:
    one, other = socket.socketpair()
    with one, other:
        ends = Channel(one, "one"), Channel(other, "other")
        yield ends
        for end in ends:
            end.close()


def read(channel: Channel) -> tuple[list[tuple[Head, bytes]], threading.Thread]:
    heard: list[tuple[Head, bytes]] = []
    thread = threading.Thread(target=channel.read, args=(lambda head, body: heard.append((head, body)),))
    thread.start()
    return heard, thread


def test_frames_come_as_they_were_sent_in_order(pair: Pair) -> None:
    one, other = pair
    heard, reader = read(other)
    sent: list[tuple[Head, bytes]] = [({"op": "a", "n": 1.5}, b""), ({"op": "ü", "n": [1]}, bytes(range(256)) * 1000)]
    for head, body in sent:
        one.put(head, body)
    wait_until(lambda: heard == sent, "they came")
    one.close()
    reader.join(PATIENCE_S)
    assert not reader.is_alive()


def test_of_droppable_frames_the_newest_stays_and_no_other_frame_is_delayed(pair: Pair) -> None:
    one, other = pair
    for number in range(100):
        one.put({"n": number}, bytes(1_000_000), key="topic", most=5)
        one.put({"kept": number})
    heard, reader = read(other)
    wait_until(lambda: any(head.get("n") == 99 for head, _ in heard), "the newest came")
    wait_until(lambda: [head["kept"] for head, _ in heard if "kept" in head] == list(range(100)), "all others came")
    numbers = [head["n"] for head, _ in heard if "n" in head]
    assert numbers == sorted(numbers)
    assert len(numbers) < 20
    one.close()
    reader.join(PATIENCE_S)


def test_a_blocked_read_is_woken_by_the_end_of_its_own_side(pair: Pair) -> None:
    _, other = pair
    _, reader = read(other)
    other.close()
    other.close()
    reader.join(PATIENCE_S)
    assert not reader.is_alive()
    other.put({"op": "late"})


def test_an_oversized_message_is_left_out_and_the_others_are_sent(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(_frames, "_LARGEST", 1000)
    one, other = pair
    heard, reader = read(other)
    one.put({"n": 1}, bytes(1001))
    one.put({"n": 2}, bytes(1000))
    wait_until(lambda: heard, "it came")
    assert [head["n"] for head, _ in heard] == [2]
    assert "1001 bytes" in caplog.text
    one.close()
    reader.join(PATIENCE_S)


def test_what_is_no_frame_ends_the_channel() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        channel = Channel(ours, "ours")
        heard, reader = read(channel)
        theirs.sendall(struct.pack("<II", 2**31, 2**31))
        reader.join(PATIENCE_S)
        assert not reader.is_alive()
        assert not heard
