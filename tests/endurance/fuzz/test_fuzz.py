"""Whatever bytes come in, only refusals come out: no other error, no hang, no memory without bound."""

import tracemalloc
from typing import Final

import hypothesis
import pytest

from tests.endurance.fuzz._changes import almost, understood, wrong_inside
from tests.endurance.fuzz._target import CORPUS, Target
from tests.endurance.fuzz.targets import TARGETS

pytestmark = pytest.mark.slow

EACH: Final = pytest.mark.parametrize("target", TARGETS.values(), ids=list(TARGETS))
EXAMPLES: Final = 100
FEW: Final = hypothesis.settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
)
MOST_BYTES: Final = 24 << 20
"""What a hostile message of 20,000 bytes may have Python hold at once, and a margin for what is made only once."""


@EACH
def test_the_corpus_is_taken_and_what_was_found_breaks_nothing_any_more(target: Target) -> None:
    assert target.corpus
    for path in target.corpus:
        taken = target.takes(path.read_bytes())
        assert taken or path.name.startswith("found-"), path


def test_each_corpus_is_of_a_target() -> None:
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)


@EACH
def test_input_that_is_almost_right_is_accepted_or_refused(target: Target) -> None:
    @FEW
    @hypothesis.given(almost(target, [path.read_bytes() for path in target.corpus]))
    def tried(data: bytes) -> None:
        target.takes(data)

    tried()


WITH_PARTS: Final = [
    target for target in TARGETS.values() if any(understood(path.read_bytes()) for path in target.corpus)
]


@pytest.mark.parametrize("target", WITH_PARTS, ids=lambda target: target.name)
def test_input_that_is_wrong_inside_is_accepted_or_refused(target: Target) -> None:
    values = [value for path in target.corpus for value in understood(path.read_bytes())]

    @FEW
    @hypothesis.given(wrong_inside(values))
    def tried(data: bytes) -> None:
        target.takes(data)

    tried()


HOSTILE: Final = {
    "nested lists": b"[" * 20_000,
    "nested maps": b'{"a":' * 4_000,
    "nested tables": b"a." * 500 + b"a=1",
    "nested in TOML": b"a=" + b"[" * 20_000,
    "nested in MessagePack": b"\x91" * 20_000,
    "a very long list": b"\xdd\xff\xff\xff\xff" + bytes(1000),
    "a very long map": b"\xdf\xff\xff\xff\xff" + bytes(1000),
    "very long bytes": b"\xc6\xff\xff\xff\xff" + bytes(1000),
    "nothing": bytes(20_000),
    "all ones": b"\xff" * 20_000,
    "headers": b"\xff\xff\xfd\x00" * 5_000,
    "beginnings": b"\xff\xff\x01\xfa\x02" * 4_000,
    "predicates": b"p(" * 10_000,
    "commas": b"a," * 10_000,
    "lines": b"robotmode\n" * 2_000,
    "one line": b"a" * 20_000,
    "digits": b"a = " + b"9" * 10_000,
}


@EACH
def test_hostile_messages_take_bounded_memory(target: Target) -> None:
    target.takes(target.corpus[0].read_bytes())
    for name, data in HOSTILE.items():
        tracemalloc.start()
        try:
            target.takes(data)
            assert tracemalloc.get_traced_memory()[1] < MOST_BYTES, name
        finally:
            tracemalloc.stop()
