"""Streams in tests: a battery that is listened to, and who listens."""

from typing import NamedTuple

from trade import Container, Handle, Sample, Stream, service, where
from trade.transport.memory import InFlightMessage, MessageKind

PATIENCE_S = 20.0
"""How long a test waits for what must come; far above what it takes."""
FAST_HZ = 200.0


class Battery:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0
        self.percent = 100
        self.error: Exception | None = None

    @service(effect="read")
    def count(self) -> int:
        self.asked += 1
        if self.error is not None:
            raise self.error
        return self.asked

    @service(effect="read")
    def charge(self) -> int:
        self.asked += 1
        return self.percent

    @service(effect="read")
    def cell(self, number: int) -> int:
        return number

    @service
    def swap(self) -> None: ...


class Display:
    """Shows what it is given."""

    def __init__(self) -> None:
        self.shown: list[int] = []

    @service
    def show(self, value: int) -> None:
        self.shown.append(value)


class Two(NamedTuple):
    """Who listens, and who is listened to."""

    here: Container
    there: Container
    battery: Battery

    def service(self, name: str) -> Handle:
        return self.here.find(where(name=name, group="rosie"), wait_s=PATIENCE_S)


def some(stream: Stream, count: int) -> list[Sample]:
    return [stream.next(PATIENCE_S) for _ in range(count)]


def is_sample(passage: InFlightMessage) -> bool:
    """One that is sent from one container to another."""
    return (
        passage.key.startswith("stream/")
        and passage.kind not in (MessageKind.RISE, MessageKind.FALL)
        and not passage.arrived
    )


def numbers(samples: list[Sample]) -> list[int]:
    return [sample.number for sample in samples]
