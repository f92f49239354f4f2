"""Strict or straight through: what a local call copies and checks, and what a remote one always does."""

from typing import Any

import pytest

from trade import service
from trade.errors import ConfigurationError, InvalidArgument


class Box:
    kept: Any = None

    @service
    def keep(self, items: list[int]) -> list[int]:
        self.kept = items
        return items

    @service(strict=False)
    def keep_as_it_is(self, items: list[int]) -> list[int]:
        self.kept = items
        return items


@pytest.fixture
def local(offer: Any, request: pytest.FixtureRequest) -> bool:
    return "[local" in request.node.name


@pytest.mark.parametrize("how", ["call", "start"])
@pytest.mark.parametrize("name", ["keep", "keep_as_it_is"])
def test_only_a_local_call_that_is_not_strict_hands_over_the_very_object(
    offer: Any, local: bool, name: str, how: str
) -> None:
    box = Box()
    keep = offer(box)(name)
    items = [1, 2]
    result = keep(items) if how == "call" else keep.start(items).result(20)
    assert result == box.kept == items
    straight = local and name == "keep_as_it_is"
    assert (box.kept is items, result is items) == (straight, straight)


@pytest.mark.parametrize("name", ["keep", "keep_as_it_is"])
def test_only_a_local_call_that_is_not_strict_is_not_checked(offer: Any, local: bool, name: str) -> None:
    box = Box()
    keep = offer(box)(name)
    if local and name == "keep_as_it_is":
        assert keep("text") == "text"
        with pytest.raises(TypeError):
            keep()
        return
    for wrong in (("text",), ()):
        with pytest.raises(InvalidArgument):
            keep(*wrong)
    assert box.kept is None


def test_what_needs_physical_resources_is_always_strict(offer: Any) -> None:
    class Arm:
        @service(uses=["joint"], strict=False)
        def move(self, angle_rad: float) -> None: ...

        @service(effect="stop")
        def stop(self) -> None: ...

    with pytest.raises(ConfigurationError, match=r"robot.move: it needs physical resources, so its arguments are"):
        offer(Arm())
