"""``trade use``: a choice for this user's programs, which options and the environment override."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from trade import Settings
from trade.default_system import chosen_file
from trade.errors import ConfigurationError
from trade_gateway.cli import app


@pytest.fixture(autouse=True)
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of the choice, which does not exist yet; the environment names no system."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for name in ("TRADE_SYSTEM", "TRADE_CONNECT"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "config" / "trade" / "use.toml"


def trade(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def in_use(*options: str) -> tuple[str, str]:
    shown = json.loads(trade(*options, "use", "--json").output)
    return shown["system"], shown["source"]


def test_a_chosen_system_is_in_use_for_programs_until_the_choice_ends(file: Path) -> None:
    default = Settings.read().system
    chosen = trade("use", "lab", "--connect", "tcp/127.0.0.1:7450", "--connect", "tcp/127.0.0.1:7451")
    assert (chosen.exit_code, chosen.output.splitlines()[0]) == (0, f"in use: lab, by trade use ({file})")
    settings = Settings.read()
    assert (settings.system, settings.explicit_system) == ("lab", True)
    assert settings.connect == ("tcp/127.0.0.1:7450", "tcp/127.0.0.1:7451")
    assert file.stat().st_mode & 0o777 == 0o600
    assert trade("use", "other").exit_code == 0
    assert (Settings.read().system, Settings.read().connect) == ("other", ())
    assert trade("use", "--clear").exit_code == trade("use", "--clear").exit_code == 0
    assert Settings.read().system == default
    assert in_use() == (default, "the default: your user and this host")


def test_an_option_and_the_environment_override_the_whole_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    trade("use", "lab", "--connect", "tcp/127.0.0.1:7450")
    assert Settings.read(system="option").connect == ()
    assert in_use("--system", "option") == ("option", "the option --system")
    monkeypatch.setenv("TRADE_SYSTEM", "variable")
    assert (Settings.read().system, Settings.read().connect) == ("variable", ())
    assert in_use() == ("variable", "the environment variable TRADE_SYSTEM")
    monkeypatch.delenv("TRADE_SYSTEM")
    monkeypatch.setenv("TRADE_CONNECT", "tcp/127.0.0.1:9999")
    assert (Settings.read().system, Settings.read().connect) == ("lab", ("tcp/127.0.0.1:9999",))


def test_settings_of_an_environment_that_is_given_know_no_choice() -> None:
    trade("use", "lab")
    assert Settings.read(environment={}).system != "lab"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["a b"], "is no name for a system"),
        (["lab", "--connect", "tls/robot:7450"], "TRADE_TLS is not set"),
        (["lab", "--connect", "nonsense"], "nonsense"),
        (["lab", "--tls", "/nowhere"], "/nowhere"),
        (["lab", "--clear"], "not both"),
        (["--connect", "tcp/127.0.0.1:7450"], "name the system, too"),
    ],
    ids=["name", "certificate", "endpoint", "folder", "both", "no-system"],
)
def test_a_wrong_choice_is_refused_and_changes_nothing(file: Path, words: list[str], says: str) -> None:
    trade("use", "lab")
    before = file.read_bytes()
    refused = trade("use", *words)
    assert isinstance(refused.exception, ConfigurationError)
    assert says in str(refused.exception)
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("TRADE_SYSTEM =", "cannot be read"),
        ("", "has no TRADE_SYSTEM"),
        ("TRADE_SYSTEM = 5", "wrong TRADE_SYSTEM"),
        ('TRADE_SYSTEM = "lab"\nTRADE_CREDENTIALS = "me:secret"', "wrong TRADE_CREDENTIALS"),
    ],
    ids=["toml", "empty", "type", "unknown"],
)
def test_a_broken_file_is_an_error_that_names_the_remedy(file: Path, text: str, says: str) -> None:
    file.parent.mkdir(parents=True)
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(ConfigurationError, match=f"use.toml.*{says}.*trade use --clear"):
        Settings.read()
    assert Settings.read(system="named").system == "named"


def test_a_file_that_others_may_write_is_refused(file: Path) -> None:
    trade("use", "lab")
    file.chmod(0o666)
    with pytest.raises(ConfigurationError, match="others may write"):
        Settings.read()
    assert trade("use", "lab").exit_code == 0  # it is written again


def test_without_a_home_directory_there_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CONFIG_HOME")

    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", homeless)
    assert chosen_file({}) is None
    assert Settings.read(container="me", identity="me").system
