"""Standard error of a command that another process ran, as people read it."""

from trade.command_output import as_text, last_line

JSON = '{"error":"ConfigurationError","message":"head.toml: no such port","data":{"where":"head.toml"}}'


def test_an_error_in_json_is_a_line_of_text() -> None:
    text = as_text(f"warning: a full disk\n{JSON}\n")
    assert text == "warning: a full disk\nConfigurationError: head.toml: no such port"


def test_other_lines_stay_as_they_are() -> None:
    for line in ("NotAnError: {}", '{"error": 3}', "[1, 2]", "", '{"error":"A"}', '"text"'):
        assert as_text(line) == line


def test_the_last_line_is_the_last_one_with_text() -> None:
    assert last_line(f"first\n  {JSON}  \n\n \n") == "ConfigurationError: head.toml: no such port"
    assert last_line(f"{JSON}\nkilled\n") == "killed"
    assert last_line("\n \n") == ""
    assert last_line("") == ""
