"""Garbage collections skip the objects of a robot that is up: its bus threads would wait for them."""

import gc
from collections.abc import Iterator

import pytest

from trade_gateway.process._signals import settle


@pytest.fixture(autouse=True)
def _thaw() -> Iterator[None]:
    yield
    gc.unfreeze()


def test_existing_objects_are_left_out_of_collections_and_later_ones_are_not() -> None:
    stood = len(gc.get_objects())
    settle()
    assert len(gc.get_objects()) < stood / 20
    later = [[] for _ in range(1000)]  # type: ignore[var-annotated]
    assert len(gc.get_objects()) > len(later)
