"""``trade.stream``: services sampled while a client listens, once for all listeners."""

import itertools
import time
from collections.abc import Sequence
from typing import Any

import pytest

from tests.unit.trade.stream_listeners import FAST_HZ, PATIENCE_S, Battery, Two, is_sample, numbers, some
from trade import Handle, Stream, where
from trade._streams.rate import Pace
from trade._streams.source import RateRequest, Source
from trade.errors import ConfigurationError
from trade.protocol.messages import EMPTY, PROTOCOL
from trade.protocol.samples import STEPS_HZ, StreamSample, stream_key
from trade.testing import MemorySystem
from trade.transport.base import Publisher

pytestmark = pytest.mark.virtual_time


def test_samples_come_in_order_with_the_time_they_were_taken_at(two: Two) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ, keep=1000) as stream:
        samples = some(stream, 5)
    assert numbers(samples) == [1, 2, 3, 4, 5]
    assert [sample.value for sample in samples] == [1, 2, 3, 4, 5]
    assert all(early.at_ns < late.at_ns for early, late in itertools.pairwise(samples))
    assert all(early.at <= late.at for early, late in itertools.pairwise(samples))


def test_the_two_times_of_a_sample_are_of_one_moment(two: Two, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first sample waits for its publisher. A recording adds the difference of its times to all later ones."""
    transport, made_ns = two.there._parts.transport, list[int]()
    publish = transport.publish

    def slowly(key: str, **options: Any) -> Publisher:
        if key.startswith("stream/"):
            time.sleep(0.5)
            made_ns.append(time.monotonic_ns())
        return publish(key, **options)

    monkeypatch.setattr(transport, "publish", slowly)
    with two.here.stream(two.service("count"), hz=FAST_HZ, keep=1000) as stream:
        first, *_, last = some(stream, 5)
    assert first.at - first.at_ns / 1e9 == pytest.approx(last.at - last.at_ns / 1e9, abs=0.25)
    assert first.at_ns > made_ns[0]


def test_a_service_without_listeners_is_not_polled(two: Two) -> None:
    assert two.battery.asked == 0
    other = Battery()
    two.there.register(other, "lab")
    with two.here.stream(two.service("count"), hz=FAST_HZ) as stream:
        some(stream, 2)
    with two.here.stream(where(name="count", group="lab"), hz=FAST_HZ, keep=1000) as clock:
        some(clock, 3)  # by now it knows that the first one has ended
        asked = two.battery.asked
        some(clock, 20)
    assert two.battery.asked == asked


def test_many_listeners_cost_one(two: Two) -> None:
    streams = [two.here.stream(two.service("count"), hz=FAST_HZ, keep=1000) for _ in range(5)]
    heard = [some(stream, 20) for stream in streams]
    assert all(sample.value == sample.number for samples in heard for sample in samples)
    for stream in streams:
        stream.close()


def test_samples_are_sent_once_for_all_listeners_and_never_without_one(memory: MemorySystem, apart: Two) -> None:
    put: list[int] = []
    third = memory.container("third")
    handle = third.find(where(name="count", group="rosie"))
    memory.tap(lambda passage: put.append(1) if is_sample(passage) else None)
    with apart.here.stream(apart.service("count"), hz=FAST_HZ, keep=1000) as one:
        last = some(one, 10)[-1]
        assert len(put) <= apart.battery.asked
        with third.stream(handle, hz=FAST_HZ, keep=1000) as other:
            first = other.next(PATIENCE_S)
            assert first.number > last.number
            assert first.value == first.number


def test_a_listener_that_wants_fewer_samples_gets_fewer(two: Two) -> None:
    with (
        two.here.stream(two.service("count"), hz=FAST_HZ, keep=1000) as fast,
        two.here.stream(two.service("count"), hz=FAST_HZ / 10, keep=1000) as slow,
    ):
        some(fast, 2)
        first, *_, last = some(slow, 6)
    periods = (last.at_ns - first.at_ns) / 1e9 * FAST_HZ / 10
    assert periods >= 4.5  # five, of which the last may be half a one early


@pytest.mark.parametrize(
    ("source_hz", "hz", "taken"), [(200, 200, 100), (200, 20, 10), (200, 150, 75), (20, 200, 100), (200, 199, 100)]
)
def test_a_rate_is_kept_to_whatever_the_source_does(source_hz: int, hz: int, taken: int) -> None:
    pace = Pace(hz)
    jitter_ns = itertools.cycle((0, 400_000, -300_000, 900_000))
    moments = [int(tick * 1e9 / source_hz) + next(jitter_ns) for tick in range(100)]
    assert sum(pace.takes(moment) for moment in moments) == pytest.approx(taken, abs=1)


def test_after_a_pause_no_more_are_put_than_before() -> None:
    pace = Pace(10)
    assert pace.takes(0)
    assert pace.takes(10_000_000_000)
    assert sum(pace.takes(10_000_000_000 + tick * 5_000_000) for tick in range(1, 101)) <= 6


def alone(source: Handle) -> Stream:
    """A stream that receives what the test sends."""
    return Stream(
        *("s", source, 100.0, lambda _: 0), on_change=False, if_=None, keep=9, opened_by=None, ended=lambda _: None
    )


def hear(stream: Stream, number: int, at_ns: int = 0) -> None:
    stream.hear(StreamSample(PROTOCOL, number, 0.0, at_ns, failed=False, body=EMPTY))


def test_a_source_that_restarts_its_count_has_lost_nothing(apart: Two) -> None:
    stream = alone(apart.service("count"))
    for number in (9, 1, 2):
        hear(stream, number)
    assert [sample.dropped for sample in some(stream, 3)] == [0, 0, 0]


def test_samples_of_another_rate_are_counted_for_themselves(apart: Two) -> None:
    stream = alone(apart.service("count"))
    hear(stream, 1)
    stream.at_rate(50)
    hear(stream, 40)
    hear(stream, 42)
    assert [sample.dropped for sample in some(stream, 3)] == [0, 0, 1]


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("passing", "wanted", "given"),
    [
        (STEPS_HZ, 33, 33),
        (STEPS_HZ[:5], 200, 20),
        (STEPS_HZ[:5], 12.5, 10),
        (STEPS_HZ[:5], 0.5, 0.5),
        (STEPS_HZ[3:5], 2, 2),
        ((), 33, 33),
    ],
    ids=["all", "fewer", "a step below", "slower than any", "not all seen", "none seen"],
)
def test_a_listener_behind_a_gateway_gets_the_rate_that_it_passes(
    apart: Two,
    memory: MemorySystem,
    monkeypatch: pytest.MonkeyPatch,
    eventually: Any,
    passing: Sequence[float],
    wanted: float,
    given: float,
) -> None:
    put: list[str] = []
    signs = [stream_key(apart.service("count").key, hz) for hz in passing]
    monkeypatch.setattr(apart.here._parts.transport, "bridged", lambda: True)
    monkeypatch.setattr(apart.here._parts.transport, "present", lambda pattern, timeout_s: signs)
    with apart.here.stream(apart.service("count"), hz=wanted) as stream:
        assert stream.hz == given
        memory.tap(lambda passage: put.append(passage.key) if is_sample(passage) else None)
        assert eventually(lambda: len(put) > 1)
    assert put[-1].rpartition("/")[2] == f"{given:g}"


@pytest.mark.realtime
def test_when_a_gateway_lets_more_pass_or_less_its_listeners_follow(
    apart: Two, monkeypatch: pytest.MonkeyPatch, eventually: Any
) -> None:
    passing = list(STEPS_HZ[:5])
    key = apart.service("count").key
    monkeypatch.setattr(apart.here._parts.transport, "bridged", lambda: True)
    monkeypatch.setattr(
        apart.here._parts.transport, "present", lambda pattern, timeout_s: [stream_key(key, hz) for hz in passing]
    )
    with apart.here.stream(apart.service("count"), hz=FAST_HZ) as stream:
        assert stream.hz == 20
        passing.extend(STEPS_HZ[5:])
        assert eventually(lambda: stream.hz == FAST_HZ)
        del passing[3:]
        assert eventually(lambda: stream.hz == 5)
        heard = [stream.next(PATIENCE_S) for _ in range(3)]
        assert heard[-1].dropped == 0


def test_the_same_source_puts_each_rate_by_itself(apart: Two, memory: MemorySystem) -> None:
    put: list[str] = []
    with (
        apart.here.stream(apart.service("count"), hz=FAST_HZ) as fast,
        apart.here.stream(apart.service("count"), hz=FAST_HZ / 10, keep=100) as slow,
    ):
        some(fast, 1)
        some(slow, 1)
        memory.tap(lambda passage: put.append(passage.key) if is_sample(passage) else None)
        samples = some(slow, 5)
    rates = [key.rpartition("/")[2] for key in put]
    assert set(rates) == {"200", "20"}
    assert [sample.dropped for sample in samples] == [0] * 5
    assert samples[-1].at_ns - samples[0].at_ns > 3 * 10 * 1e9 / FAST_HZ  # who is late makes it longer


def test_rates_that_look_alike_in_keys_are_one(apart: Two) -> None:
    with (
        apart.here.stream(apart.service("count"), hz=FAST_HZ, keep=100) as one,
        apart.here.stream(apart.service("count"), hz=FAST_HZ + 1e-6, keep=100) as other,
    ):
        for stream in (one, other):
            heard = numbers(some(stream, 10))
            assert heard == list(range(heard[0], heard[0] + 10))


def test_the_number_of_rates_of_a_source_is_limited(apart: Two) -> None:
    source = Source(
        apart.service("count").key, lambda _: None, apart.there._parts.transport, itertools.count(1).__next__
    )
    for rate in range(64):
        source.request(("session", f"{rate}"), RateRequest("tester", rate + 1, on_change=False))
    with pytest.raises(ConfigurationError, match="64 different rates"):
        source.request(("session", "another"), RateRequest("tester", 0.5, on_change=False))
    source.request(("session", "the same"), RateRequest("tester", 1, on_change=False))


def test_on_change_only_what_differs_is_given_and_the_first_at_once(two: Two) -> None:
    with two.here.stream(two.service("charge"), hz=FAST_HZ, on_change=True) as stream:
        found: list[int] = []
        for percent in (90, 80, 70):
            found.append(stream.next(PATIENCE_S).value)
            two.battery.percent = percent
        found.append(stream.next(PATIENCE_S).value)
    assert found == [100, 90, 80, 70]


def test_an_unchanged_value_is_rarely_published(memory: MemorySystem, apart: Two, eventually: Any) -> None:
    put: list[str] = []
    memory.tap(lambda passage: put.append(passage.key) if is_sample(passage) else None)
    with apart.here.stream(apart.service("charge"), hz=FAST_HZ, on_change=True) as stream:
        assert eventually(lambda: apart.battery.asked > 300)
        assert len(put) < apart.battery.asked / 10
        assert [stream.next(PATIENCE_S).value] == [100]
        with pytest.raises(TimeoutError):
            stream.next(0.01)


def test_a_listener_who_comes_late_hears_at_once_what_has_not_changed(two: Two) -> None:
    with two.here.stream(two.service("charge"), hz=FAST_HZ, on_change=True) as one:
        assert one.next(PATIENCE_S).value == 100
        with two.here.stream(two.service("charge"), hz=FAST_HZ, on_change=True) as other:
            assert other.next(PATIENCE_S).value == 100


def test_a_slower_listener_gets_the_last_change_too(two: Two) -> None:
    charge = two.service("charge")
    with (
        two.here.stream(charge, hz=FAST_HZ, on_change=True) as fast,
        two.here.stream(charge, hz=FAST_HZ / 20, on_change=True) as slow,
    ):
        assert [fast.next(PATIENCE_S).value, slow.next(PATIENCE_S).value] == [100, 100]
        two.battery.percent = 99
        assert [fast.next(PATIENCE_S).value, slow.next(PATIENCE_S).value] == [99, 99]


def test_only_values_that_meet_the_condition_are_given(two: Two) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ, if_=lambda value: value % 3 == 0, keep=100) as stream:
        assert [sample.value for sample in some(stream, 3)] == [3, 6, 9]


def test_a_condition_that_fails_says_so(two: Two) -> None:
    with (
        two.here.stream(two.service("count"), hz=FAST_HZ, if_=lambda value: 1 // (value - value)) as stream,
        pytest.raises(ZeroDivisionError),
    ):
        stream.next(PATIENCE_S)


def test_a_slow_listener_gets_the_newest_sample_and_the_number_of_missed_ones(two: Two, eventually: Any) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ, keep=4) as stream:
        assert eventually(lambda: (latest := stream.latest()) is not None and latest.number > 20)
        first, *others = some(stream, 4)
        assert first.number > 4
        assert 0 < first.dropped < first.number  # the first ones may come before the subscription has arrived
        together = others[-1].number - first.number
        assert sum(sample.dropped + 1 for sample in others) == together


def test_a_frozen_listener_learns_how_many_samples_it_missed(apart: Two) -> None:
    """It began out of turn, and the samples before it stood still were a little late, the one after it was not."""
    stream = alone(apart.service("count"))
    for number, at_ms in ((1, 5.2), (2, 10.3), (3, 20.3), (7, 60.0)):
        hear(stream, number, int(at_ms * 1e6))
    assert [sample.dropped for sample in some(stream, 4)] == [0, 0, 0, 3]


def test_the_latest_sample_can_be_read_without_taking_it(two: Two, eventually: Any) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ, keep=1000) as stream:
        assert eventually(lambda: (latest := stream.latest()) is not None and latest.value >= 3)
        assert stream.next(PATIENCE_S).value == 1


def test_a_fast_listener_does_not_wait_for_a_slow_one(two: Two) -> None:
    with two.here.stream(two.service("count"), hz=0.1, keep=10) as slow:
        slow.next(PATIENCE_S)
        began = time.monotonic()
        with two.here.stream(two.service("count"), hz=50, keep=100) as fast:
            some(fast, 5)
        assert time.monotonic() - began < 2
