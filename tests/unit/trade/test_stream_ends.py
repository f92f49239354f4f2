"""``trade.stream``: how samples are taken, what goes wrong with them, and how streams end."""

import asyncio
import itertools
import threading
import time
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.stream_listeners import FAST_HZ, PATIENCE_S, Battery, Display, Two
from trade import Container, where
from trade._streams.source import RateRequest, Source
from trade.errors import AccessDenied, ConfigurationError, ServiceGone, SessionEnded, SourceLost
from trade.protocol.samples import stream_key
from trade.testing import MemorySystem
from trade.transport.memory import MemoryTransport


def test_an_error_of_the_service_is_raised_and_the_stream_continues(two: Two) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ, keep=10_000) as stream:
        stream.next(PATIENCE_S)
        two.battery.error = ValueError("no reading")
        with pytest.raises(ValueError, match="no reading"):
            while True:
                stream.next(PATIENCE_S)
        with pytest.raises(ValueError, match="no reading"):
            stream.latest()
        two.battery.error = None
        while True:
            try:
                assert stream.next(PATIENCE_S).value > 1
                break
            except ValueError:
                continue


def test_async_with_ends_a_stream(two: Two) -> None:
    async def first() -> bool:
        stream = await asyncio.to_thread(two.here.stream, two.service("count"), hz=FAST_HZ)
        async with stream as samples:
            async for sample in samples:
                assert sample.value >= 1
                break
        return stream.ended

    assert asyncio.run(first())


def test_a_service_that_is_withdrawn_ends_its_streams(two: Two) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ) as stream:
        stream.next(PATIENCE_S)
        two.there.deregister(two.battery)
        with pytest.raises(ServiceGone):
            while True:
                stream.next(PATIENCE_S)
        assert stream.ended
        with pytest.raises(ServiceGone):
            stream.latest()


def test_a_stream_whose_source_ends_says_so(start_container: Any) -> None:
    here, there = start_container("here"), start_container("there")
    there.register(Battery(), "rosie")
    with here.stream(where(name="count", group="rosie"), hz=FAST_HZ) as stream:
        stream.next(PATIENCE_S)
        there.close()
        with pytest.raises(SourceLost, match="there"):
            while True:
                stream.next(PATIENCE_S)


def test_after_a_partition_the_samples_are_back_by_themselves(memory: MemorySystem, apart: Two) -> None:
    with apart.here.stream(apart.service("charge"), hz=FAST_HZ, on_change=True) as stream:
        assert stream.next(PATIENCE_S).value == 100
        memory.partition("here", "there")
        memory.advance(5)
        with pytest.raises(SourceLost):
            stream.next(PATIENCE_S)
        with pytest.raises(SourceLost):
            stream.latest()
        asked = apart.battery.asked
        with pytest.raises(TimeoutError):
            stream.next(0.1)
        assert apart.battery.asked <= asked + 1  # no client listens any more, as far as the source can tell
        memory.heal()
        memory.settle()
        assert stream.next(PATIENCE_S).value == 100


def test_a_closed_stream_gives_nothing_more_and_ends_its_loop(two: Two) -> None:
    stream = two.here.stream(two.service("count"), hz=FAST_HZ)
    values: list[int] = []
    for sample in stream:
        values.append(sample.value)
        if len(values) == 3:
            stream.close()
    assert len(values) == 3
    stream.close()
    with pytest.raises(ConfigurationError, match="closed"):
        stream.next(PATIENCE_S)


def test_a_wait_for_a_sample_ends_when_the_stream_is_closed(two: Two) -> None:
    stream = two.here.stream(two.service("charge"), hz=FAST_HZ, on_change=True)
    stream.next(PATIENCE_S)
    closing = threading.Timer(0.05, stream.close)
    closing.start()
    with pytest.raises(ConfigurationError, match="closed"):
        stream.next(PATIENCE_S)
    closing.join()


def test_streams_end_with_the_session_that_opened_them_and_others_continue(two: Two) -> None:
    with two.here.stream(two.service("count"), hz=FAST_HZ) as own:
        with two.here.open_session("page"):
            page = two.here.stream(two.service("count"), hz=FAST_HZ)
            page.next(PATIENCE_S)
        with pytest.raises(SessionEnded):
            while True:
                page.next(PATIENCE_S)
        last = own.next(PATIENCE_S).number
        while own.next(PATIENCE_S).number <= last:
            pass


def test_streams_end_with_their_container(start_container: Any) -> None:
    here, there = start_container("here"), start_container("there")
    there.register(Battery(), "rosie")
    stream = here.stream(where(name="count", group="rosie"), hz=FAST_HZ)
    stream.next(PATIENCE_S)
    here.close()
    with pytest.raises(ConfigurationError, match="closed"):
        while True:
            stream.next(PATIENCE_S)


def test_a_listener_whose_container_ends_is_forgotten(start_container: Any, eventually: Any) -> None:
    here, there, battery = start_container("here"), start_container("there"), Battery()
    there.register(battery, "rosie")
    here.stream(where(name="count", group="rosie"), hz=FAST_HZ).next(PATIENCE_S)
    here.close()
    before = -1

    def is_left_alone() -> bool:
        nonlocal before
        known, before = before, battery.asked
        threading.Event().wait(5 / FAST_HZ)
        return known == battery.asked

    assert eventually(is_left_alone)


def test_samples_are_passed_on_to_a_service(two: Two, eventually: Any) -> None:
    display = Display()
    two.there.register(display, "screen")
    show = two.here.find(where(name="show", group="screen"), wait_s=PATIENCE_S)
    with two.here.stream(two.service("count"), hz=FAST_HZ, call=show):
        assert eventually(lambda: len(display.shown) >= 3)
    assert display.shown == sorted(set(display.shown))


def test_samples_are_passed_on_to_a_function_whose_errors_end_nothing(
    two: Two, eventually: Any, caplog: pytest.LogCaptureFixture
) -> None:
    given: list[int] = []

    def show(value: int) -> None:
        given.append(value)
        raise ValueError("no display")

    with two.here.stream(two.service("count"), hz=FAST_HZ, call=show):
        assert eventually(lambda: len(given) >= 3)
    assert [record.getMessage() for record in caplog.records if "no display" in record.getMessage()] != []
    assert len([record for record in caplog.records if "no display" in record.getMessage()]) == 1


def test_samples_come_to_asyncio(two: Two) -> None:
    async def listen() -> list[int]:
        found: list[int] = []
        with two.here.stream(two.service("count"), hz=FAST_HZ, keep=1000) as stream:
            async for sample in stream:
                found.append(sample.value)
                if len(found) == 4:
                    stream.close()
        return found

    assert asyncio.run(listen()) == [1, 2, 3, 4]


def test_waiting_in_asyncio_may_be_given_up_without_losing_a_sample(two: Two) -> None:
    async def listen() -> int:
        with two.here.stream(two.service("charge"), hz=FAST_HZ, on_change=True) as stream:
            await stream.anext()
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(stream.anext(), 0.05)
            two.battery.percent = 50
            return (await stream.anext()).value

    assert asyncio.run(listen()) == 50


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("swap", {}, "only read"),
        ("cell", {}, "needs number"),
        ("count", {"hz": 0}, "hz must be"),
        ("count", {"hz": float("nan")}, "hz must be"),
        ("count", {"hz": 1e6}, "hz must be"),
        ("count", {"keep": 0}, "keep must be"),
        ("count", {"if_": "value > 3"}, "if_ must be a function"),
        ("count", {"call": 3}, "call must be"),
    ],
)
def test_what_cannot_be_listened_to_is_refused(apart: Two, name: str, options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigurationError, match=problem):
        apart.here.stream(apart.service(name), **options)


def test_a_source_refuses_what_is_not_its_own(apart: Two) -> None:
    listen = apart.here.find(where(name="listen", container="here"))
    with pytest.raises(ConfigurationError, match="not a service of container here"):
        listen("mine", apart.service("count"), 10.0)


def test_what_is_no_sample_is_dropped_and_counted(memory: MemorySystem, apart: Two, eventually: Any) -> None:
    with apart.here.stream(apart.service("charge"), hz=FAST_HZ, on_change=True) as stream:
        stream.next(PATIENCE_S)
        key = apart.service("charge").key
        forger = MemoryTransport(memory.network)
        forger.publish(stream_key(key, FAST_HZ)).put(b"garbage")
        assert eventually(lambda: apart.here.dropped_messages == 1)
        apart.battery.percent = 1
        assert stream.next(PATIENCE_S).value == 1
        forger.close()


POLICY = """
[roles.all]
call = ["*"]
register = ["*"]
READ

[identities]
"*" = ["all"]
"""


def policy_file(folder: Any, read: str) -> Any:
    path = folder / "policy.toml"
    path.write_text(POLICY.replace("READ", read))
    return path


def test_listening_to_a_service_needs_the_right_to_read_it(start_container: Any, tmp_path: Any) -> None:
    here = start_container("here", policy=policy_file(tmp_path, 'read = ["lab"]'))
    [count] = [handle for handle in here.register(Battery(), "rosie") if handle.name == "count"]
    with pytest.raises(AccessDenied, match="read"):
        here.stream(count)


def test_a_source_refuses_a_listener_that_bypasses_the_policy(start_container: Any, tmp_path: Any) -> None:
    there = start_container("there", policy=policy_file(tmp_path, 'read = ["lab"]'))
    there.register(Battery(), "rosie")
    with pytest.raises(AccessDenied, match="read"):
        start_container("here").stream(where(name="count", group="rosie"))


@pytest.mark.realtime
def test_a_listener_that_loses_the_right_gets_no_more_samples(start_container: Any, tmp_path: Any) -> None:
    there = start_container("there", policy=policy_file(tmp_path, 'read = ["rosie"]'))
    there.register(Battery(), "rosie")
    with start_container("here").stream(where(name="count", group="rosie"), hz=FAST_HZ) as stream:
        stream.next(PATIENCE_S)
        there.load_policy(policy_file(tmp_path, 'read = ["lab"]'))
        with pytest.raises(AccessDenied, match="read"):
            while True:
                stream.next(PATIENCE_S)


SOURCE = """
class Battery:
    asked = 0
    @service(effect="read")
    def count(self) -> int:
        self.asked += 1
        return self.asked

container = Container(Settings.read(container="there"))
container.register(Battery(), "rosie")
say("up")
hear()
"""


@pytest.mark.realtime
def test_a_source_that_is_killed_is_lost(start_container: Any, start_program: Any) -> None:
    program = start_program(SOURCE)
    assert program.heard() == "up"
    with start_container("here").stream(where(name="count", group="rosie"), hz=FAST_HZ) as stream:
        stream.next(PATIENCE_S)
        program.kill()
        with pytest.raises(SourceLost):
            while True:
                stream.next(PATIENCE_S)


def test_a_listener_that_does_not_renew_is_dropped(here: Container) -> None:
    battery = Battery()
    [count] = [handle for handle in here.register(battery, "rosie") if handle.name == "count"]
    local = here._parts.providers.service(count.key)
    source = Source(count.key, lambda _: local, here._parts.transport, itertools.count(1).__next__)
    now = time.monotonic_ns()
    source.request(("session", "kept"), RateRequest("tester", 1, on_change=False, until_ns=now + 10**12))
    assert source.tick() is not None
    source.request(("session", "kept"), RateRequest("tester", 1, on_change=False, until_ns=now))
    assert source.tick() is None
    assert battery.asked == 1


@pytest.mark.virtual_time
def test_the_end_of_a_session_ends_its_streams_and_no_others(two: Two) -> None:
    one, other = two.here.open_session("page"), two.here.open_session("page")
    with one.use():
        mine = two.here.stream(two.service("count"), hz=20)
    with other.use():
        others = two.here.stream(two.service("count"), hz=20)
    mine.next(PATIENCE_S)
    others.next(PATIENCE_S)
    one.close()
    wait_until(lambda: mine.ended)
    assert isinstance(mine.why_ended, SessionEnded)
    assert not others.ended
    others.close()
    other.close()
