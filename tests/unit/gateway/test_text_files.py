"""Text files as other systems write them: byte-order marks are read or named, and line ends stay."""

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import trade_robotfile
from tests.support.certificates import Papers
from tests.support.simulated_robots import HEAD
from trade._security.certificates import Certificate
from trade._security.policy_file import read_policy
from trade.default_system import chosen_settings
from trade.errors import ConfigurationError
from trade.rules._file import read_rules
from trade.text_files import as_before, as_text
from trade_drivers import load
from trade_gateway.cli.watching._profile import read as read_profile
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.config.document import Document
from trade_gateway.http._authentication import Tokens, add_token
from trade_gateway.language._lexicon import read_lexicon
from trade_gateway.ros._file import read_ros_file
from trade_gateway.ros_messages._types import Types
from trade_gateway.supervisor._system_file import read_system_file
from trade_robotfile import RobotFileError

_EXAMPLES = Path(__file__).parents[3] / "examples"
_ROS = "[ros]\nversion = 2\n"
_RULES = """[rule.a]
when = { missing = { group = "rosie" } }
do = [{ wait_for = { group = "rosie" }, s = 30 }]
cooldown_s = 60
"""
_LEXICON = '[[phrase]]\nhear = ["how do you do"]\nask = "services"\nsay = "fine"\n'
_PROFILE = '{"v": 1, "after": {}}\n'


def _definition(path: Path) -> object:
    folder = path.parent / "types" / "lab_msgs" / "msg"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "Mark.msg").write_bytes(path.read_bytes())
    return [field.name for field in Types(2, [path.parent / "types"]).fields("lab_msgs/msg/Mark")]


def _of_user(path: Path) -> object:
    folder = path.parent / "trade"
    folder.mkdir(exist_ok=True)
    (folder / "use.toml").write_bytes(path.read_bytes())
    return chosen_settings({"XDG_CONFIG_HOME": str(path.parent)})


def _gateway(path: Path) -> object:
    policy = 'gateways = ["door"]\n[roles.viewer]\nread = ["*"]\n[identities]\nplanner = ["viewer"]\n'
    (path.parent / "policy.toml").write_text(policy, encoding="utf-8")
    if not (path.parent / "pki").exists():
        Papers(path.parent / "pki").of("door", purpose="gateway", addresses=["192.168.7.1", "10.0.0.7"])
    return read_gateway_file(path)


def _robot_of_ros(path: Path) -> object:
    (path.parent / "arm.urdf").write_bytes(path.read_bytes())
    file = path.parent / "ros.toml"
    file.write_text(f'{_ROS}[[to_ros.robot]]\ngroup = "rosie"\nurdf = "arm.urdf"\n', encoding="utf-8")
    return read_ros_file(file)


KINDS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "robot": (HEAD, load),
    "simulated robot": (HEAD, trade_robotfile.load),
    "gateway": ((_EXAMPLES / "gateway.toml").read_text(encoding="utf-8"), _gateway),
    "system": ('[system]\nname = "lab"\nsupervisor = "keeper"\n[container.a]\nprogram = ["true"]\n', read_system_file),
    "policy": ((_EXAMPLES / "policy.toml").read_text(encoding="utf-8"), read_policy),
    "rules": (_RULES, read_rules),
    "ros": (f'{_ROS}[[to_ros.joint_states]]\ngroup = "rosie"\n', read_ros_file),
    "urdf": ('<?xml version="1.0"?>\n<robot name="a"><link name="base"/></robot>\n', _robot_of_ros),
    "message definition": ("float64 x\nfloat64 y\n", _definition),
    "lexicon": (_LEXICON, read_lexicon),
    "tokens": (f'[tokens]\n{"0" * 64} = "anna"\n', Tokens),
    "profile": (_PROFILE, read_profile),
    "chosen system": ('TRADE_SYSTEM = "lab"\n', _of_user),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_a_file_with_a_byte_order_mark_is_read_as_without(tmp_path: Path, kind: str, line_end: str) -> None:
    text, read = KINDS[kind]
    file = tmp_path / "file.toml"
    file.write_text(text, encoding="utf-8")
    plain = read(file)
    file.write_bytes(codecs.BOM_UTF8 + text.replace("\n", line_end).encode())
    marked = read(file)
    assert marked == plain or type(marked).__eq__ is object.__eq__


@pytest.mark.parametrize("kind", KINDS)
def test_the_byte_order_mark_of_another_encoding_is_named(tmp_path: Path, kind: str) -> None:
    text, read = KINDS[kind]
    file = tmp_path / "file.toml"
    for encoding in ("utf-16", "utf-32"):
        file.write_bytes(text.encode(encoding))
        with pytest.raises(
            (ConfigurationError, RobotFileError, UnicodeDecodeError),
            match=f"byte-order mark of {encoding.upper()}; save it as UTF-8",
        ):
            read(file)


@pytest.mark.parametrize("name", ["ca.pem", "cert.pem", "key.pem"])
def test_a_byte_order_mark_in_a_certificate_is_named(tmp_path: Path, name: str) -> None:
    folder = Papers(tmp_path / "pki").of("arm")
    assert Certificate.read(folder).identity == "arm"
    file = folder / name
    file.write_bytes(codecs.BOM_UTF8 + file.read_bytes())
    with pytest.raises(ConfigurationError, match=rf"{name}.*begins with a byte-order mark"):
        Certificate.read(folder)


def test_an_edited_policy_keeps_its_byte_order_mark_and_line_ends(tmp_path: Path) -> None:
    file = tmp_path / "policy.toml"
    file.write_bytes(codecs.BOM_UTF8 + b"a = 1\r\nb = 2\r\n")
    document = Document(file)
    shown = document.read()
    assert shown.text == "a = 1\nb = 2\n"
    document.write("a = 1\nc = 3\nb = 2\n", shown.version, lambda: None)
    assert file.read_bytes() == codecs.BOM_UTF8 + b"a = 1\r\nc = 3\r\nb = 2\r\n"


def test_a_new_token_keeps_the_line_ends_of_its_file(tmp_path: Path) -> None:
    file = tmp_path / "tokens.toml"
    file.write_bytes(b'[tokens]\r\n"%s" = "anna"\r\n' % (b"0" * 64))
    token = add_token(file, "bert")
    assert Tokens(file).who(token) == "bert"
    assert file.read_bytes().count(b"\n") == file.read_bytes().count(b"\r\n")


LINES = st.lists(st.sampled_from(["", "a = 1", "b = 2", "# c", "d = 'ä'"]), min_size=1, max_size=8)
ENDS = st.sampled_from(["\n", "\r\n"])


@given(LINES, LINES, ENDS, st.booleans())
def test_a_new_text_has_the_line_ends_of_its_file(before: list[str], after: list[str], end: str, marked: bool) -> None:
    mark = codecs.BOM_UTF8 if marked else b""
    contents, text = mark + end.join([*before, ""]).encode(), "\n".join([*after, ""])
    written = as_before(contents, text)
    assert as_text(written) == text
    assert written == mark + end.join([*after, ""]).encode()
    assert as_before(contents, as_text(contents)) == contents


def test_lines_that_stay_keep_their_own_ends() -> None:
    assert as_before(b"a\r\nb\nc\r\n", "a\nb\nx\nc\n") == b"a\r\nb\nx\r\nc\r\n"
