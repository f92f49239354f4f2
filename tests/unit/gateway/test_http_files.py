"""The policy and the rules over HTTP: shown, tried and changed by administrators, who do not lock themselves out."""

import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.http_clients import Opened, govern, opened
from tests.support.policies import EVERYTHING, policy_text
from tests.support.two_joint_robot import Robot
from trade.rules import Rules
from trade.testing import memory_system
from trade_gateway.cli.watching.rule_file import RuleFile

pytestmark = pytest.mark.virtual_time

POLICY = policy_text(
    "bert=guest tester=all olga=operator vera=viewer",
    all=EVERYTHING,
    operator="read=* administer=trade",
    viewer="read=*",
    guest="read=robot",
)
RULES = """
[rule.go]
when = { present = { group = "robot.a", name = "go_on" } }
if = { service = { group = "robot.a", name = "where_is_it" }, above = 5 }
do = [{ call = "$service", args = [1.0] }]
cooldown_s = 60
"""


class Files:
    """An HTTP gateway with a policy, and a container with rules."""

    def __init__(self, made: Opened, folder: Path) -> None:
        self.made = made
        self.policy, self.rules = folder / "policy.toml", folder / "rules.toml"

    def ask(self, who: str, method: str, path: str, body: Any = None) -> Any:
        return self.made.client(who).ask(method, path, body)


@pytest.fixture
def files(tmp_path: Path) -> Iterator[Files]:
    with memory_system() as system:
        robot = Robot(system, "a")
        (tmp_path / "rules.toml").write_text(RULES)
        ruled = system.container("rules")
        with Rules(ruled, tmp_path / "rules.toml"), opened(robot.me, tmp_path) as (gateway, tokens):
            ruled.register_functions(RuleFile(ruled, tmp_path / "rules.toml"), "rule_file")
            system.settle()
            govern(robot, tmp_path, POLICY)
            yield Files(Opened(robot, gateway, tokens), tmp_path)


def test_a_policy_is_tried_and_then_written_and_applied(files: Files) -> None:
    files.policy.chmod(0o640)
    shown = files.ask("olga", "GET", "/policy/file").body
    assert (shown["path"], shown["text"]) == (str(files.policy), POLICY)
    text = POLICY.replace('vera = ["viewer"]', 'vera = ["viewer"]\ncarl = ["operator"]')
    text = text.replace('[roles.viewer]\nread = ["*"]\n', "[roles.viewer]\n")
    tried = files.ask("olga", "POST", "/policy/test", {"text": text}).body
    assert tried["problem"] == ""
    assert tried["effects"] == [
        "carl may read *.",
        "carl may administer trade.",
        "vera may no longer read *.",
    ]
    assert {'+carl = ["operator"]', '-read = ["*"]'} <= set(tried["diff"])
    assert files.policy.read_text() == POLICY
    assert files.ask("carl", "GET", "/policy/file").status == 403
    saved = files.ask("olga", "PUT", "/policy/file", {"text": text, "version": shown["version"]})
    assert "within two seconds" in saved.body["text"]
    assert (files.policy.read_text(), stat.S_IMODE(files.policy.stat().st_mode)) == (text, 0o640)
    assert files.ask("carl", "GET", "/policy/file").status == 200


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('olga = ["operator"]', 'olga = ["viewer"]', "olga would no longer administer the system"),
        ("[identities]", 'revoked = ["olga"]\n[identities]', "unknown key"),
        ("[roles.all]", 'revoked = ["olga"]\n[roles.all]', "olga is revoked"),
        ('tester = ["all"]', 'tester = ["viewer"]', "tester would no longer administer the system"),
        ('read = ["*"]', "read = 7", "must be a list"),
        ("[identities]", "[identities", "not valid TOML"),
    ],
)
def test_a_policy_that_is_wrong_or_locks_out_its_editor_is_refused(
    files: Files, old: str, new: str, reason: str
) -> None:
    text, version = POLICY.replace(old, new, 1), files.ask("olga", "GET", "/policy/file").body["version"]
    assert reason in files.ask("olga", "POST", "/policy/test", {"text": text}).body["problem"]
    refused = files.ask("olga", "PUT", "/policy/file", {"text": text, "version": version})
    assert (refused.status, refused.title) == (400, "ConfigurationError")
    assert reason in refused.body["detail"]
    assert files.policy.read_text() == POLICY
    assert files.ask("olga", "GET", "/policy/file").status == 200


def test_a_change_that_the_editor_has_not_seen_is_not_overwritten(files: Files) -> None:
    for path, file, more in (("/policy/file", files.policy, "# more\n"), ("/rules/rules", files.rules, "# more\n")):
        get = "/rules" if path.startswith("/rules") else path
        shown = files.ask("olga", "GET", get).body
        version = (shown[0] if isinstance(shown, list) else shown)["version"]
        other = file.read_text() + "# by another editor\n"
        file.write_text(other)
        refused = files.ask("olga", "PUT", path, {"text": file.read_text() + more, "version": version})
        assert refused.status == 400, refused.body
        assert "was changed meanwhile" in refused.body["detail"]
        assert file.read_text() == other


def test_rules_are_tried_and_then_written(files: Files) -> None:
    [shown] = files.ask("vera", "GET", "/rules").body  # a reader of the system sees them
    assert (shown["container"], shown["text"]) == ("rules", RULES)
    text = RULES.replace("above = 5", "below = 5")
    tried = files.ask("olga", "POST", "/rules/rules/test", {"text": text}).body
    assert tried["problem"] == ""
    assert "would fire now" in tried["effects"][0]
    assert {'-if = { service = { group = "robot.a", name = "where_is_it" }, above = 5 }'} <= set(tried["diff"])
    assert (files.made["a"].resource.moving, files.rules.read_text()) == (False, RULES)  # the trial called nothing
    wrong = files.ask("olga", "POST", "/rules/rules/test", {"text": text.replace("do =", "did =")}).body
    assert "has no 'did'" in wrong["problem"]
    refused = files.ask("olga", "PUT", "/rules/rules", {"text": "[rule", "version": shown["version"]})
    assert (refused.status, files.rules.read_text()) == (400, RULES)
    assert files.ask("olga", "PUT", "/rules/rules", {"text": text, "version": shown["version"]}).status == 200
    assert files.rules.read_text() == text
    assert files.ask("olga", "PUT", "/rules/nowhere", {"text": text, "version": ""}).title == "NoSuchService"


def test_a_guest_does_not_read_rules(files: Files) -> None:
    assert files.ask("bert", "GET", "/services").body
    refused = files.ask("bert", "GET", "/rules")
    assert (refused.status, refused.title) == (403, "AccessDenied")


def test_a_viewer_is_refused_with_the_reason_and_nothing_is_tried_or_written(files: Files) -> None:
    files.made.robot.me.set_tracing(True)
    body = {"text": "", "version": files.ask("olga", "GET", "/policy/file").body["version"]}
    asked = [
        ("GET", "/policy/file", None),
        ("POST", "/policy/test", {"text": ""}),
        ("PUT", "/policy/file", body),
        ("POST", "/rules/rules/test", {"text": RULES}),
        ("PUT", "/rules/rules", body),
    ]
    for method, path, sent in asked:
        refused = files.ask("vera", method, path, sent)
        assert (refused.status, refused.title) == (403, "AccessDenied"), path
        assert "no rule of role viewer allows administer in trade" in refused.body["detail"]
    served = {span.service for span in files.made.robot.me.spans() if span.side == "served"}
    assert served.isdisjoint({"trade.try_rules", "trade.save_rules"})
    assert (files.policy.read_text(), files.rules.read_text()) == (POLICY, RULES)


def test_a_file_that_cannot_be_written_says_so_and_stays(files: Files) -> None:
    """There is no room for the name of the new file beside it, which would replace it."""
    long = files.policy.with_name("p" * 250)
    long.write_text(POLICY)
    files.made.robot.me.load_policy(long)
    shown = files.ask("olga", "GET", "/policy/file").body
    refused = files.ask("olga", "PUT", "/policy/file", {"text": f"{POLICY}\n", "version": shown["version"]})
    assert refused.status == 400
    assert "cannot be written" in refused.body["detail"]
    assert long.read_text() == POLICY
