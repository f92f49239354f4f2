"""The command lines of the guide, and of the pages on drivers and deployment, typed as they stand there.

Those that need no system are typed here, section by section, in a folder with what the page takes for granted. What the
others do is done, on simulated robots, by the tests that `TYPED_ELSEWHERE` names; some are not typed, and
`NOT_TYPED` says why. Of all of them tests/docs/test_docs.py looks whether the commands and their options are there.
"""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from typer.testing import CliRunner

from tests.docs.blocks import DOCS, ROOT, Section, of, said, sections
from trade_gateway.cli import app

PAGES: Final = ("guide.md", "drivers.md", "deployment.md")
TYPED_ELSEWHERE: Final = {
    Section("guide.md", "Let a system configure itself"): ["system/test_transcript.py", "system/test_witness.py"],
    Section("guide.md", "Have one robot look at another"): ["system/test_witness.py"],
    Section("guide.md", "Types of a running robot"): ["unit/gateway/test_stubs.py", "docs/test_guide.py"],
    Section("guide.md", "Devices"): ["system/test_demo.py"],
    Section("guide.md", "Have one arm follow another"): ["system/test_teleop.py"],
    Section("guide.md", "Locks, stops, e-stop"): ["system/test_lock_commands.py"],
    Section("guide.md", "Ask in sentences"): ["unit/gateway/test_ask.py", "unit/gateway/test_ask_orders.py"],
    Section("guide.md", "Observe a system"): ["system/test_traces.py", "system/test_watch.py"],
    Section("guide.md", "States of containers"): ["unit/gateway/test_states_shown.py", "unit/gateway/test_lists.py"],
    Section("guide.md", "The record of who did what"): ["system/test_audit.py"],
    Section("guide.md", "Create objects in other containers"): ["docs/test_guide.py"],
    Section("guide.md", "Other hosts"): ["system/test_starts.py"],
    Section("guide.md", "Many containers on one host"): ["system/test_hub.py"],
    Section("guide.md", "A whole system from one file"): ["system/test_transcript.py"],
    Section("guide.md", "A robot's computer that looks after itself"): ["system/test_supervisor.py"],
    Section("drivers.md", "What was wrong"): ["unit/gateway/test_faults.py"],
    Section("deployment.md", "Installing"): ["unit/gateway/test_install.py"],
}
"""Modules of tests that do what the section says, often with other names."""
NOT_TYPED: Final = {
    Section("guide.md", "Several networks"): "settings, not commands, for a host in two networks",
    Section("deployment.md", "Taking one back"): "takes two hosts: unit/trade/test_policy_watch.py tries it",
    Section("deployment.md", "Updating"): "takes root, systemd and a newer version",
    Section(
        "deployment.md", "A gateway between networks"
    ): "changes the kernel: unit/gateway/test_gateway_file.py has the warning",
    Section("deployment.md", "In a container"): "takes podman or docker: release/test_container.py tries it",
}


def test_every_command_line_is_typed_by_a_test_or_listed_with_the_reason() -> None:
    found = sections((DOCS / page for page in PAGES), "sh")
    assert found == said(globals()) | TYPED_ELSEWHERE.keys() | NOT_TYPED.keys()
    assert not [name for names in TYPED_ELSEWHERE.values() for name in names if not (ROOT / "tests" / name).exists()]


class Typist:
    """Types the lines of one section."""

    def __init__(self, section: Section) -> None:
        text = "".join(block.text for block in section.blocks("sh"))
        lines = [re.sub(r"\s+# .*|^# .*", "", line).strip() for line in text.splitlines()]
        self.left = [line for line in lines if line]
        """What was not typed yet."""

    def next(self, *with_: tuple[str, str]) -> str:
        """Type the next line, which must go well; what it says.

        Args:
            with_: words of the page, and what stands for them here.
        """
        line = self.left.pop(0)
        for before, after in with_:
            assert before in line, f"{before!r} is not in {line!r} any more"
            line = line.replace(before, after)
        return self.also(line)

    def also(self, line: str) -> str:
        """Type what the page takes for granted."""
        program, *words = shlex.split(line)
        assert program == "trade"
        ended = CliRunner().invoke(app, words, catch_exceptions=False)
        assert ended.exit_code == 0, f"{line}: {ended.output}"
        return ended.output

    def leave(self, why: str) -> None:
        """The next line is not typed."""
        assert why
        self.left.pop(0)


@pytest.fixture
def typist(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Typist]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TRADE_POLICY", raising=False)
    made, failed = Typist(request.function.section), request.session.testsfailed
    yield made
    assert not made.left or request.session.testsfailed > failed, "these were not typed"


def shown(heading: str) -> str:
    """The file that a section of the guide shows."""
    return Section("guide.md", heading).blocks("toml")[0].text


@of("guide.md", "Identities")
def test_identities(typist: Typist) -> None:
    for _ in range(4):
        typist.next()
    listed = typist.next()
    assert all(name in listed for name in ("arm", "planner", "door"))
    typist.leave("sets variables")
    typist.leave("takes an address of a network, and a robot: tests/system/test_gateway.py has them")


@of("guide.md", "Who may do what")
def test_a_policy(typist: Typist, tmp_path: Path) -> None:
    (tmp_path / "policy.toml").write_text(shown("Who may do what"))
    typist.leave("takes a robot: tests/system/test_audit.py has one under a policy")
    assert "allowed" in typist.next()
    assert "planner" in typist.next()


@of("guide.md", "A gateway")
def test_a_gateway(typist: Typist, tmp_path: Path) -> None:
    (tmp_path / "gateway.toml").write_text(shown("A gateway"))
    shutil.copy(ROOT / "examples" / "policy.toml", tmp_path)
    typist.next()
    typist.next()
    assert "is right" in typist.next()
    typist.leave("takes two interfaces and their addresses: tests/system/test_gateway.py has them")


@of("deployment.md", "Certificates")
def test_certificates(typist: Typist, tmp_path: Path) -> None:
    typist.also("trade pki init pki")
    typist.also("trade pki issue door --for gateway --address 10.0.0.7")
    before = (tmp_path / "pki/issued/door/cert.pem").read_bytes()
    typist.next()
    assert (tmp_path / "pki/issued/door/cert.pem").read_bytes() != before
    typist.leave("takes another host")


@of("deployment.md", "Backups")
def test_backups(typist: Typist, tmp_path: Path) -> None:
    """Without root, below a folder; what is put back goes to where nothing is yet."""
    for folder in ("etc", "state"):
        (tmp_path / folder).mkdir()
    (tmp_path / "etc/gateway.toml").write_text('system = "lab"\n[container.rosie]\nrobot = "head.toml"\nsim = true\n')
    shutil.copy(ROOT / "examples" / "head.toml", tmp_path / "etc")
    mine = ("sudo /opt/trade/bin/", "")
    typist.next(mine, ("/etc/trade", "etc"), ("/var/lib/trade", "state"))
    typist.next(mine)
    typist.leave("takes systemd")
    typist.next(mine, ("/etc/trade", "etc-again"), ("/var/lib/trade", "state-again"))
    assert (tmp_path / "etc-again" / "head.toml").exists()
    typist.leave("takes systemd")
