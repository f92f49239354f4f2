"""A policy that is read again by itself when its files change; what is wrong with them changes nothing."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.joint_with_policy import POLICY, Neck, find, policy, rewritten
from trade import Container, Settings
from trade.errors import AccessDenied
from trade.testing import MemorySystem
from trade.transport.memory import MemoryTransport

pytestmark = pytest.mark.virtual_time

__all__ = ["policy"]


@pytest.fixture
def watching(memory: MemorySystem, policy: Path) -> Iterator[Container]:
    """A container that was started with the policy, and offers something."""
    settings = Settings(system="memory", identity="drv", container="of-drv", policy=policy)
    with Container(settings, transport=MemoryTransport(memory.network, "of-drv")) as made:
        made.register(Neck(), "rosie.neck")
        memory.settle()
        yield made


def test_an_identity_revoked_in_the_file_is_refused_without_an_explicit_reload(
    watching: Container, memory: MemorySystem, policy: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "revoked.toml").write_text('revoked = ["thief"]')
    rewritten(policy, 'revoked = ["thief"]', 'revoked_file = "revoked.toml"')
    wait_until(lambda: "nothing is different" in caplog.text, "the list is named now")
    move = find(memory.container("asking", identity="planner"), "move")  # it has no policy, and checks no rule
    assert move(0.1) == 0.1
    (tmp_path / "revoked.toml").write_text('revoked = ["thief", "planner"]')
    wait_until(lambda: "planner is revoked now" in caplog.text, "it is read")
    with pytest.raises(AccessDenied, match="planner is revoked"):
        move(0.1)
    (tmp_path / "revoked.toml").write_text("revoked = 1")
    wait_until(lambda: "the earlier one stays" in caplog.text, "it is refused")
    assert watching.access.policy is not None
    assert "planner" in watching.access.policy.revoked
    assert caplog.text.count("the earlier one stays") == 1
    (tmp_path / "revoked.toml").write_text("revoked = []")
    wait_until(lambda: "planner is revoked no more" in caplog.text, "and it is right again")
    assert move(0.1) == 0.1


def test_a_list_that_could_not_be_read_is_read_once_it_can_be(
    watching: Container, policy: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy by another user with a later right to read changes nothing else of the file."""
    monkeypatch.setattr("trade._container.policy_reload._AGAIN_NS", 10**15)
    listed, may = tmp_path / "revoked.toml", Path.read_bytes
    listed.write_text("revoked = []")
    rewritten(policy, 'revoked = ["thief"]', 'revoked_file = "revoked.toml"')
    wait_until(lambda: "thief is revoked no more" in caplog.text, "the list is named now")

    def refused(path: Path) -> bytes:
        if path == listed:
            raise PermissionError(13, "Permission denied")
        return may(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    listed.write_text('revoked = ["planner"]')
    wait_until(lambda: "Permission denied" in caplog.text, "it cannot be read")
    monkeypatch.setattr(Path, "read_bytes", may)
    listed.chmod(0o640)
    wait_until(lambda: "planner is revoked now" in caplog.text, "it is read")
    assert watching.access.policy is not None


def test_files_that_were_refused_are_tried_again_as_they_are(
    watching: Container, policy: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade._container.policy_reload._AGAIN_NS", 10**9)
    may, down = Path.read_bytes, [False]

    def passing(path: Path) -> bytes:
        if path == policy and down[0]:
            raise OSError(5, "Input/output error")
        return may(path)

    monkeypatch.setattr(Path, "read_bytes", passing)
    rewritten(policy, 'revoked = ["thief"]', 'revoked = ["thief", "planner"]')
    down[0] = True
    wait_until(lambda: "Input/output error" in caplog.text, "it cannot be read")
    down[0] = False
    wait_until(lambda: "planner is revoked now" in caplog.text, "it is read")
    assert caplog.text.count("the earlier one stays") == 1


def test_a_policy_that_was_loaded_on_purpose_is_the_one_that_is_looked_at(
    watching: Container, policy: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = tmp_path / "other.toml"
    other.write_text(POLICY)
    watching.load_policy(other)
    rewritten(policy, 'dash = ["viewer"]', 'dash = ["chief"]')
    rewritten(other, 'dash = ["viewer"]', 'dash = ["operator"]')
    wait_until(lambda: f"{other}: other identities" in caplog.text, "it is read")
    assert str(policy) not in caplog.text
