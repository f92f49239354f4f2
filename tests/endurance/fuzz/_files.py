"""The files that people write and programs keep."""

import gzip
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final

from tests.endurance.fuzz._target import Target
from trade._estop.store import _read as read_open_estop
from trade._security.policy_file import read_policy
from trade.errors import ConfigurationError
from trade.rules._file import read_rules
from trade_drivers import parse as parse_robot
from trade_gateway.cli.operation._archive import read_archive
from trade_gateway.cli.operation._file_closure import named_files
from trade_gateway.cli.watching._audit import _noted as read_notes
from trade_gateway.cli.watching._audit import _verified as verified
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.http._authentication import Tokens
from trade_gateway.language import read_lexicon
from trade_gateway.language._memory import _read as read_memory
from trade_gateway.pki._authority import Authority
from trade_gateway.ros._file import read_ros_file
from trade_gateway.supervisor._system_file import read_system_file

_FOLDER: Final = tempfile.TemporaryDirectory(prefix="trade-fuzz-")


def in_a_file(read: Callable[[Path], Any], name: str) -> Callable[[bytes], Any]:
    """Read from a file what reads files; always the same one."""
    path = Path(_FOLDER.name) / name

    def of(data: bytes) -> Any:
        path.write_bytes(data)
        return read(path)

    return of


def _robot(data: bytes) -> Any:
    return parse_robot(data.decode(errors="replace"), "robot.toml")


@cache
def _authority() -> Path:
    return Authority.create(Path(_FOLDER.name) / "pki").folder


def _revoked(data: bytes) -> Any:
    (_authority() / "revoked.toml").write_bytes(data)
    return Authority(_authority()).revoked()


def _zipped(read: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """What it sees behind the check sums of gzip."""
    return lambda data: read(gzip.compress(data, 0))


def _toml(name: str, read: Callable[[Path], Any]) -> Target:
    return Target(name, in_a_file(read, f"{name}.toml"), (ConfigurationError,))


TARGETS: Final = [
    _toml("policy-file", read_policy),
    _toml("rules-file", read_rules),
    Target("robot-file", _robot, (ConfigurationError,)),
    _toml("gateway-file", read_gateway_file),
    _toml("system-file", read_system_file),
    _toml("named-files", named_files),
    _toml("ros-file", read_ros_file),
    _toml("lexicon", read_lexicon),
    _toml("http-tokens", Tokens),
    Target("revoked-names", _revoked, (ConfigurationError,)),
    Target("open-estop", in_a_file(read_open_estop, "e1.json")),
    Target("talk-memory", in_a_file(read_memory, "memory.json")),
    Target("audit-notes", in_a_file(read_notes, "notes.jsonl"), (ConfigurationError,)),
    Target("audit-record", in_a_file(lambda path: verified(path, {}), "e1.db")),
    Target("backup", _zipped(in_a_file(read_archive, "backup.tar.gz")), (ConfigurationError,)),
]
