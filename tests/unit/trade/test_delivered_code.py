"""Code that is brought to a container: by hash, on its list, and after what is installed."""

import io
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.policies import policy_text
from trade import Container, Settings, where
from trade._migration.delivered_code import CodeStore, hash_of, pack
from trade.errors import AccessDenied, CodeRefused, ConfigurationError, NoSuchClass
from trade.transport.memory import MemoryTransport, Network

pytestmark = pytest.mark.virtual_time

LAMP = """
from trade import service

class Lamp:
    @service
    def shine(self) -> str:
        return "bright"
"""
POLICY = policy_text("anna=chief guest=guest", chief="administer=* register=* read=* call=*", guest="read=* call=*")


@pytest.fixture
def lamp(tmp_path: Path) -> Path:
    """A package with one class, of a name that no other test uses."""
    folder = tmp_path / f"lamp_of_{tmp_path.name}".replace("-", "_")
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "lamp.py").write_text(LAMP)
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "lamp.pyc").write_text("of this computer")
    return folder


@pytest.fixture
def paths() -> Iterator[list[str]]:
    """The import path, which is as before afterwards."""
    before = list(sys.path)
    yield sys.path
    sys.path[:] = before


class Site:
    """A container that takes code, and a client."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.network = Network()
        self.running: list[Container] = []
        (folder / "policy.toml").write_text(POLICY)

    def container(self, name: str, *, identity: str = "anna", **terms: Any) -> Container:
        settings = Settings(
            system="code", identity=identity, container=name, policy=self.folder / "policy.toml", **terms
        )
        self.running.append(Container(settings, transport=MemoryTransport(self.network, name)))
        return self.running[-1]


@pytest.fixture
def site(tmp_path: Path, paths: list[str]) -> Iterator[Site]:
    made = Site(tmp_path)
    yield made
    for container in reversed(made.running):
        container.close()


def test_a_folder_is_brought_made_into_an_object_and_imported_again_after_a_restart(site: Site, lamp: Path) -> None:
    sha256, state = hash_of(pack(lamp)), site.folder / "state"
    terms: dict[str, Any] = {"state_dir": state, "code": (sha256,), "instantiable": (f"{lamp.name}.lamp:Lamp",)}
    eyes, client = site.container("eyes", **terms), site.container("client")
    with pytest.raises(NoSuchClass):
        client.call(where(name="instantiate", container="eyes"), f"{lamp.name}.lamp:Lamp")
    assert client.system.send_code("eyes", lamp) == sha256
    [shine] = client.call(where(name="instantiate", container="eyes"), f"{lamp.name}.lamp:Lamp")
    assert shine() == "bright"
    assert Path(sys.modules[f"{lamp.name}.lamp"].__file__ or "").parts[-3] == f"{sha256}.zip"
    kept = state / "code" / "code" / f"{sha256}.zip"
    eyes.close()
    sys.path.remove(str(kept))
    site.container("eyes", **terms)
    assert str(kept) in sys.path


def test_code_that_is_not_on_the_list_is_neither_kept_nor_imported(site: Site, lamp: Path) -> None:
    state = site.folder / "state"
    site.container("eyes", state_dir=state, code=("0" * 64,), instantiable=("*",))
    client, before = site.container("client"), list(sys.path)
    with pytest.raises(CodeRefused, match="trade container --code") as error:
        client.system.send_code("eyes", lamp)
    assert (error.value.sha256, error.value.container) == (hash_of(pack(lamp)), "eyes")
    assert sys.path == before
    assert not list(state.rglob("*.zip"))


def test_only_an_administrator_brings_code(site: Site, lamp: Path) -> None:
    state = site.folder / "state"
    site.container("eyes", state_dir=state, code=(hash_of(pack(lamp)),))
    guest = site.container("client", identity="guest")
    with pytest.raises(AccessDenied):
        guest.system.send_code("eyes", lamp)
    assert not list(state.rglob("*.zip"))


def test_a_kept_archive_that_was_changed_is_not_imported(tmp_path: Path, lamp: Path, paths: list[str]) -> None:
    archive = pack(lamp)
    sha256 = CodeStore(tmp_path / "kept", [hash_of(archive)], "eyes").add(archive)
    kept = tmp_path / "kept" / f"{sha256}.zip"
    paths.remove(str(kept))
    kept.write_bytes(archive + b"x")
    CodeStore(tmp_path / "kept", [sha256], "eyes")
    assert str(kept) not in paths


def test_what_is_installed_is_not_replaced(tmp_path: Path, paths: list[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "json.py").write_text("raise RuntimeError")
    archive = pack(tmp_path / "mine")
    CodeStore(tmp_path / "kept", [hash_of(archive)], "eyes").add(archive)
    assert paths[-1].endswith(".zip")


def test_the_same_files_give_the_same_archive_without_what_belongs_to_a_computer(lamp: Path) -> None:
    first = pack(lamp)
    (lamp / "lamp.py").touch()
    (lamp / "__pycache__" / "lamp.pyc").write_text("of another computer")
    (lamp / ".secret").write_text("x")
    assert pack(lamp) == first
    assert zipfile.ZipFile(io.BytesIO(first)).namelist() == [f"{lamp.name}/__init__.py", f"{lamp.name}/lamp.py"]
    (lamp / "lamp.py").write_text(LAMP + "\n")
    assert pack(lamp) != first


def archive_of(*names: str) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name in names:
            archive.writestr(name, "")
    return made.getvalue()


@pytest.mark.parametrize(
    ("archive", "problem"),
    [
        (b"print('no archive')", "is no wheel, no zip file"),
        (archive_of("readme.md"), "has no modules"),
        (archive_of("fast.py", "fast/_core.cpython-311-aarch64-linux-gnu.so"), "compiled modules are not imported"),
        (b"x" * ((32 << 20) + 1), "at most 33554432 are taken"),
    ],
    ids=["no archive", "no modules", "compiled", "too large"],
)
def test_what_python_cannot_import_is_refused_by_both_ends(
    tmp_path: Path, paths: list[str], archive: bytes, problem: str
) -> None:
    before, sent = list(paths), tmp_path / "sent.whl"
    sent.write_bytes(archive)
    with pytest.raises(ConfigurationError, match=problem):
        pack(sent)
    with pytest.raises(CodeRefused, match=problem):
        CodeStore(tmp_path / "kept", [hash_of(archive)], "eyes").add(archive)
    assert paths == before
    assert not (tmp_path / "kept").exists()


def test_a_container_without_a_folder_or_with_a_full_disk_says_so(tmp_path: Path, lamp: Path, paths: list[str]) -> None:
    archive, before = pack(lamp), list(paths)
    with pytest.raises(CodeRefused, match="TRADE_STATE_DIR"):
        CodeStore(None, [hash_of(archive)], "eyes").add(archive)
    (tmp_path / "file").write_text("where the folder would be")
    with pytest.raises(CodeRefused, match="cannot be kept"):
        CodeStore(tmp_path / "file" / "code", [hash_of(archive)], "eyes").add(archive)
    assert paths == before


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nowhere.*cannot be read"):
        pack(tmp_path / "nowhere")


def test_a_hash_of_the_settings_is_checked() -> None:
    with pytest.raises(ConfigurationError, match="64 hexadecimal digits"):
        Settings(system="code", identity="anna", container="eyes", code=("abc",))
