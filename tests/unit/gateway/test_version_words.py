"""What an operator sees while containers of two protocol versions are up."""

import pytest

from trade import ContainerInfo, EstopReport
from trade.protocol.messages import PROTOCOL
from trade_gateway.cli.motion._estop import _say
from trade_gateway.cli.services._services import _containers_table
from trade_gateway.terminal._output import Output

pytestmark = pytest.mark.virtual_time

OTHER = PROTOCOL + 1
REPORT = EstopReport(
    id="abc",
    confirmed=("dora/dora", "me/trade", "rosie/rosie"),
    missing=("door/door", "legs/legs"),
    failed={"arm/arm": "arm.elbow still moves"},
    versions={"rosie/rosie": OTHER, "door/door": OTHER, "arm/arm": OTHER},
)


def said(report: EstopReport, done: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    _say(Output(as_json=False), report, "lab", done, "me/trade")
    return capsys.readouterr().out.splitlines()


def test_an_e_stop_names_those_of_another_version_with_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert said(REPORT, "stopped", capsys)[:-1] == [
        "stopped: dora/dora",
        f"stopped: rosie/rosie (protocol version {OTHER})",
        f"FAILED: arm/arm (protocol version {OTHER}): arm.elbow still moves",
        f"MISSING: door/door (protocol version {OTHER}) did not answer",
        "MISSING: legs/legs did not answer",
    ]


def test_a_clearing_says_what_is_to_be_done_about_those_of_another_version(capsys: pytest.CaptureFixture[str]) -> None:
    missing = [line for line in said(REPORT, "cleared", capsys) if line.startswith("MISSING")]
    assert missing == [
        f"MISSING: door/door (protocol version {OTHER}) can be cleared only by a `trade` of its own version",
        "MISSING: legs/legs did not answer",
    ]


def info(name: str, protocol: int) -> ContainerInfo:
    known = protocol == PROTOCOL
    return ContainerInfo(name, name, f"{name}-1", "desk" if known else "", 7 if known else 0, 2, 5, protocol)


def test_the_table_of_containers_has_a_column_for_versions_while_there_are_two() -> None:
    columns, rows = _containers_table([info("dora", PROTOCOL), info("rosie", OTHER)])
    assert columns == ("CONTAINER", "IDENTITY", "PROTOCOL", "HOST", "PID", "SERVICES", "EPOCH")
    assert rows == [
        ("dora", "dora", str(PROTOCOL), "desk", "7", "5", "dora-1"),
        ("rosie", "rosie", f"{OTHER} (here {PROTOCOL})", "?", "?", "?", "rosie-1"),
    ]
    columns, rows = _containers_table([info("dora", PROTOCOL), info("silent", 0)])
    assert dict(zip(columns, rows[1], strict=True)) == {
        "CONTAINER": "silent",
        "IDENTITY": "silent",
        "EPOCH": "silent-1",
        **dict.fromkeys(("PROTOCOL", "HOST", "PID", "SERVICES"), "?"),
    }
    columns, _ = _containers_table([info("dora", PROTOCOL)])
    assert "PROTOCOL" not in columns
