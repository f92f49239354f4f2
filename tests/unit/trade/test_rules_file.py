"""What a rules file says, and what is said of one that is wrong."""

from pathlib import Path

import pytest

from trade import where
from trade.errors import ConfigurationError
from trade.rules import Rule, read_rules

STEP = '{ call = { name = "go" } }'
DO = f"do = [{STEP}]"
EVERY = "when = { every_s = 9 }"
LEFT = 'when = { left = { name = "look" } }'


def read(folder: Path, body: str, name: str = "r") -> Rule:
    path = folder / "rules.toml"
    path.write_text(f"[rule.{name}]\n{body}")
    return read_rules(path)[name]


def test_a_file_is_read_as_it_says(tmp_path: Path) -> None:
    rule = read(
        tmp_path,
        """
        when = { changed = { name = "look", group = "rosie", healthy = false } }
        if = { service = { name = "load", container = "$container" }, field = "cpu", above = 0.8 }
        do = [
          { call = { name = "deregister", group = "trade", container = "$container" }, args = ["$service"] },
          { wait_for = { achieves = "see(?x)" }, s = 30 },
          { call = "$service", args = { speed = 0.5 }, deadline_s = 2, always = true },
        ]
        cooldown_s = 60
        """,
    )
    assert rule.when.selection is not None
    assert rule.when.selection.constraint() == where(name="look", group="rosie", healthy=False)
    assert str(rule.when) == "changed group='rosie' and not healthy and name='look'"
    assert str(rule.if_) == "the service with container='$container' and name='load', cpu above 0.8"
    assert [step.always for step in rule.do] == [False, False, True]
    assert str(rule.do[1]) == "wait 30 s for achieves='see(?x)'"
    assert rule.cooldown_s == 60


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (f"{DO}", r"rule\.r: when is missing; write when = "),
        (LEFT, r"rule\.r: do is missing; write do = "),
        (f"{LEFT}\ndo = []", r"rule\.r\.do: has no steps"),
        (f"when = {{}}\n{DO}", "when: says nothing; it is exactly one"),
        (f'when = {{ left = {{ name = "a" }}, every_s = 1 }}\n{DO}', "when: says left and every_s; it is exactly one"),
        (f"when = {{ every_s = 0 }}\n{DO}", r"when\.every_s: must be a number from 0\.001"),
        (f"when = {{ every_s = nan }}\n{DO}", r"when\.every_s: must be a number from 0\.001"),
        (f'when = {{ every = 3 }}\n{DO}', r"rule\.r\.when: has no 'every'; there is joined, left, .* present"),
        (f"when = {{ left = {{}} }}\n{DO}", r"when\.left: says nothing; there is name, group"),
        (f'when = {{ left = {{ nam = "a" }} }}\n{DO}', r"when\.left: has no 'nam'; there is name, group"),
        (f'when = {{ left = {{ group = "rosie.*" }} }}\n{DO}', "would match nothing"),
        (f'when = {{ left = {{ container = "$container" }} }}\n{DO}', "known only once it has happened"),
        (f'when = {{ missing = {{ name = "a" }} }}\n{DO}', r"cooldown_s: missing; say how long to wait"),
        (f'when = {{ present = {{ name = "a" }} }}\n{DO}', r"cooldown_s: missing; say how long to wait"),
        (f"{LEFT}\n{DO}\ncooldown_s = -1", r"cooldown_s: must be a number from 0"),
        (f"{LEFT}\n{DO}\ncooldown_s = 'long'", r"cooldown_s: Expected `float`, got `str`"),
        (f"{LEFT}\n{DO}\ncooldown = 3", r"rule\.r: has no 'cooldown'; there is when, do, if, cooldown_s"),
        (f"{LEFT}\ndo = [{{ args = [1] }}]", r"do\[0\]: is one of call and wait_for"),
        (f'{LEFT}\ndo = [{STEP}, {{ call = "go" }}]', r"do\[1\]\.call: 'go' is no service; write call = "),
        (f'{LEFT}\ndo = [{{ call = {{ name = "go" }}, args = [["$servce"]] }}]', r"'\$servce' is no placeholder"),
        ('when = { every_s = 9 }\ndo = [{ call = "$service" }]', "is of rules with joined, .* present or if"),
        (f'{EVERY}\n{DO}\nif = {{ service = {{ name = "a" }}, args = ["$service"] }}', "this one has every_s"),
        (f'{EVERY}\n{DO}\nif = {{ service = {{ container = "$container" }} }}', "this one has every_s"),
        (f'{LEFT}\n{DO}\nif = {{ above = 3 }}', r"rule\.r\.if: service is missing; write service = "),
        (f'{LEFT}\n{DO}\nif = {{ service = {{ name = "a" }}, above = 3, is = 4 }}', "is cannot be combined with"),
        (f'{LEFT}\ndo = [{{ call = {{ name = "go" }}, deadline_s = 0 }}]', r"do\[0\]\.deadline_s: must be a number"),
        ("when = 3 = 4", "not valid TOML"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, body: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said) as wrong:
        read(tmp_path, body)
    assert str(tmp_path / "rules.toml") in str(wrong.value)


def test_a_file_that_is_not_there_and_a_name_that_is_none_are_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read: No such file"):
        read_rules(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match="is no name"):
        read(tmp_path, f"{LEFT}\n{DO}", name='"a rule"')
    with pytest.raises(ConfigurationError, match="rule"):
        path = tmp_path / "rules.toml"
        path.write_text("[rules.r]\n")
        read_rules(path)
