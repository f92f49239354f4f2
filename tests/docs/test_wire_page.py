"""What the page of the wire protocol says of defaults, types and folders is what the codec and the folders are."""

import os
import re
import tempfile
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin

import msgspec
import pytest
from msgspec import Struct, structs

from tests.docs.blocks import DOCS
from trade._paths import runtime_folder
from trade.protocol.messages import ProviderInfo, ServiceInfo, decode_provider
from trade.transport.credentials import user_secret

PAGE = (DOCS / "wire-protocol.md").read_text(encoding="utf-8")
PROVIDER = {"revision": 1, "groups": ["a"], "kind": "Arm", "host": "rosie", "pid": 1}


def rows(after: str) -> list[list[str]]:
    """The first table after a text."""
    table = re.search(r"(?:^\|.*\n)+", PAGE[PAGE.index(after) :], re.MULTILINE)
    assert table is not None
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table.group().splitlines()[2:]]


def said(kind: Any) -> str:
    if isinstance(kind, UnionType) or type(None) in get_args(kind):
        return " or ".join("nil" if one is type(None) else said(one) for one in get_args(kind))
    if hasattr(kind, "__metadata__"):
        return said(get_args(kind)[0])
    if get_origin(kind) is tuple:
        return f"array of {said(get_args(kind)[0])}"
    return {str: "text", int: "int", msgspec.Raw: "map"}.get(kind) or ("map" if get_origin(kind) else kind.__name__)


def left_out(field: structs.FieldInfo) -> str:
    if field.required:
        return "malformed"
    value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    if isinstance(value, msgspec.Raw):
        value = msgspec.msgpack.decode(value)
    return "nil" if value is None else "empty" if value in ("", (), {}) else f"{value}" if value == 1 else f"`{value}`"


@pytest.mark.parametrize("kind", [ProviderInfo, ServiceInfo])
def test_fields_have_the_types_and_defaults_of_the_page(kind: type[Struct]) -> None:
    reported = [row[:3] for row in rows(f"**{kind.__name__}** map:")]
    assert reported == [[f"`{one.encode_name}`", said(one.type), left_out(one)] for one in structs.fields(kind)]


def test_what_a_service_leaves_out_is_understood_as_the_page_says() -> None:
    data = msgspec.msgpack.encode({**PROVIDER, "services": [{"name": "turn", "signature": "turn()"}]})
    [service] = decode_provider(data).services
    assert (service.effect, service.cancel, service.uses) == ("actuate", None, ())
    for cancel in (None, "halt"):
        reported = {**PROVIDER, "services": [{"name": "turn", "signature": "turn()", "cancel": cancel}]}
        assert decode_provider(msgspec.msgpack.encode(reported)).services[0].cancel == cancel


@pytest.mark.parametrize("named", ["TRADE_RUNTIME_DIR", "/run/user/<uid>", "neither"])
def test_the_runtime_folder_is_where_the_page_says(named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported = {row[0].strip("`"): row[1] for row in rows("The runtime folder is")}
    assert set(reported) == {"TRADE_RUNTIME_DIR", "/run/user/<uid>", "neither"}
    uid = str(os.getuid())
    for place in ("run/user", "tmp", "named"):
        (tmp_path / place).mkdir(parents=True)
    monkeypatch.setattr("trade._paths._OF_LOGINS", tmp_path / "run" / "user")
    monkeypatch.setattr("trade._paths._ALWAYS", tmp_path / "tmp")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "elsewhere"))
    monkeypatch.delenv("TRADE_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "other"))  # it does not count
    if named == "TRADE_RUNTIME_DIR":
        monkeypatch.setenv(named, str(tmp_path / "named"))
    if named != "neither":
        (tmp_path / "run" / "user" / uid).mkdir()
    folder = runtime_folder()
    expected = reported[named].split("`")[1].replace("$TRADE_RUNTIME_DIR", "named").replace("<uid>", uid)
    assert folder == tmp_path / expected.lstrip("/")
    user, password = user_secret()
    assert (user, password) == ("host", (folder / "@secret").read_text(encoding="ascii").strip())
