"""The command of `make explore`: what it prints, how it ends, and that it prints the same each time."""

import os
import signal
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from tests.endurance.explore import __main__ as command
from tests.endurance.explore._stage import Outcome
from tests.endurance.explore._story import draw

ROOT = Path(__file__).parents[3]
COMMAND = [sys.executable, "-m", "tests.endurance.explore"]
BAD, AT = 5, 1
"""A seed with several troubles, and the number of the one under which it fails here."""


def drawn(seed: int, only: list[int] | None = None) -> Outcome:
    """What a story would be that breaks a rule under one of the troubles of one seed."""
    _, cast, troubles = draw(seed)
    kept = [one for one in troubles if only is None or one.number in only]
    wrong = ["it moved"] if seed == BAD and any(one.number == AT for one in kept) else []
    return Outcome(seed, cast, kept, calls=2, elapsed_s=36.0, violations=wrong)


def test_a_story_that_breaks_a_rule_is_printed_with_the_command_for_its_fewest_troubles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "play", drawn)
    assert command.main(["--first", str(BAD - 1), "--seeds", "3"]) == 1
    said = capsys.readouterr().out
    assert f"the fewest troubles: make explore SEEDS=1 ARGS='--first {BAD} --only {AT}'" in said
    assert said.endswith("3 stories, 0.030 virtual hours, 6 calls, 1 with a violation: 5\n")
    assert command.main(["--seeds", "1", "--first", str(BAD), "--only", "0"]) == 0
    assert command.main(["--seeds", "3", "--first", "100", "--quiet"]) == 0
    quiet = capsys.readouterr().out
    assert quiet.count("seed 10") == 0
    assert "troubles: " in quiet


def test_a_mutant_ends_with_the_first_story_that_shows_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken: list[str] = []
    monkeypatch.setitem(command.MUTANTS, "no-fence", lambda: broken.append("no-fence"))
    monkeypatch.setattr(command, "play", drawn)
    assert command.main(["--first", str(BAD - 1), "--seeds", "30", "--mutant", "no-fence"]) == 1
    assert broken == ["no-fence"]
    assert "2 stories, 0.020 virtual hours, 4 calls, 1 with a violation: 5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--mutant", "no-such"], "invalid choice: 'no-such'"),
        (["--seeds", "0"], "0 stories show nothing"),
        (["--seeds", "-3"], "'-3' is not a whole number"),
        (["--first", "one"], "'one' is not a whole number"),
        (["--only", "0;1", "--seeds", "1"], "'0;1' is not a whole number"),
        (["--only", "0,1"], "--only is about the troubles of one story, and 50 are asked for"),
        (["--only", "", "--seeds", "1"], "name at least one trouble"),
        (["--only", "0,9", "--seeds", "1"], "story 1 has no trouble 9; it has 0 "),
        (["--fast"], "unrecognized arguments: --fast"),
    ],
)
def test_arguments_that_are_wrong_are_refused(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main(words)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err


@pytest.mark.realtime
def test_another_process_with_another_hash_seed_prints_the_same() -> None:
    said = [
        subprocess.run(
            [*COMMAND, "--seeds", "4"],
            cwd=ROOT,
            env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
            capture_output=True,
            check=True,
        ).stdout
        for hash_seed in (1, 2)
    ]
    assert said[0] == said[1]


class Story:
    """What a weak reference refers to."""


def test_ctrl_c_is_noticed_wherever_it_arrives(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python ignores what is raised in the callback of a weak reference."""

    def interrupted(seed: int, _only: list[int] | None) -> Outcome:
        story = Story()
        end = weakref.ref(story, lambda _: signal.raise_signal(signal.SIGINT))
        del story
        assert end() is None
        return drawn(seed)

    monkeypatch.setattr(command, "play", interrupted)
    assert command.main(["--seeds", "30"]) == 130
    said = capsys.readouterr()
    assert "interrupted after 1 of 30 stories" in said.err
    assert "1 stories, 0.010 virtual hours, 2 calls, 0 with a violation" in said.out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.realtime
def test_ctrl_c_prints_what_was_found_so_far() -> None:
    with subprocess.Popen(
        [*COMMAND, "--seeds", "500"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("seed 1: ")
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted after " in errors
    assert " with a violation" in said
    assert "Traceback" not in errors
