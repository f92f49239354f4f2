"""All that our packages need exists for the computers of robots."""

import re

import pytest

from tests.release import wheels

pytestmark = pytest.mark.slow


def test_all_but_one_library_can_be_installed_on_arm64_without_a_compiler() -> None:
    assert wheels.lacking(wheels.LOCK.read_text(encoding="utf-8")).keys() == wheels.ALLOWED


@pytest.mark.parametrize(
    ("package", "pattern", "pythons"),
    [
        ("msgspec", r"msgspec[^\"]*-cp312-[^\"]*aarch64\.whl", ["3.12"]),
        ("pyserial", r"pyserial-[^\"]*-none-any\.whl", ["3.10", "3.11", "3.12", "3.13"]),
        ("eclipse-zenoh", r"eclipse_zenoh[^\"]*aarch64\.whl", ["3.10", "3.11", "3.12", "3.13"]),
    ],
)
def test_a_wheel_that_the_index_has_not_is_missed(package: str, pattern: str, pythons: list[str]) -> None:
    lock, replaced = re.subn(pattern, "other-1.0-cp39-cp39-win_amd64.whl", wheels.LOCK.read_text(encoding="utf-8"))
    assert replaced
    assert wheels.lacking(lock)[package] == pythons
