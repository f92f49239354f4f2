"""Wheels are the same bytes on every computer, and say what may be done with them."""

import email
import os
import re
import shutil
import sys
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest

from tests.release import wheels
from tests.release._build import MEMBERS, ROOT, build
from tests.release._licences import AS_THEY_ARE, licence, not_permissive
from tests.release._pythons import pythons

UV = os.environ.get("UV") or shutil.which("uv") or str(ROOT / ".uv" / "bin" / "uv")
needs_uv = pytest.mark.skipif(not Path(UV).exists(), reason="uv is not there; `make` fetches it into .uv/")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str], Path]:
    """Where wheels are, the hashes of them all, and what they were built from."""
    folder = tmp_path_factory.mktemp("one")
    return folder / "dist", build(UV, folder / "repository", folder / "dist"), folder / "repository"


@needs_uv
def test_two_copies_become_the_same_bytes(built: tuple[Path, dict[str, str], Path], tmp_path: Path) -> None:
    _, first, _ = built
    again = build(UV, tmp_path / "quite" / "another", tmp_path / "dist", umask=0o077)
    assert len(first) == 2 * len(MEMBERS)
    assert again == first


@needs_uv
def test_each_wheel_has_its_licence_its_types_and_nothing_that_is_made_while_it_runs(
    built: tuple[Path, dict[str, str], Path],
) -> None:
    folder, _, _ = built
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as opened:
            names = opened.namelist()
            [licence_file] = [name for name in names if name.endswith("licenses/LICENSE")]
            assert opened.read(licence_file) == (ROOT / "LICENSE").read_bytes()
            [metadata] = [name for name in names if name.endswith("METADATA")]
            said = email.message_from_bytes(opened.read(metadata))
        assert said["License-Expression"] == "Apache-2.0"
        assert any(name.endswith("py.typed") for name in names)
        assert not [name for name in names if re.search(r"__pycache__|\.pyc$|\.so$|(^|/)tests/", name)]


def test_the_five_packages_have_one_version_and_pin_each_other_to_it() -> None:
    texts = [(ROOT / member / "pyproject.toml").read_text(encoding="utf-8") for member in MEMBERS]
    [version] = {found for text in texts for found in re.findall(r'^version = "(.*)"$', text, re.MULTILINE)}
    pin = re.compile(r'"trade-(?:checks|core|drivers|gateway|hil-sim|robotfile)([=<>~].*?)"')
    pins = [found for text in texts for found in pin.findall(text)]
    assert pins
    assert set(pins) == {f"=={version}"}
    assert f"\n## {version} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@needs_uv
def test_the_python_that_runs_this_is_found_and_a_program_that_is_none_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "python3.10").write_text("#!/bin/sh\necho cpython 3.10.99 /nowhere; exit 1\n")
    (tmp_path / "python3.10").chmod(0o755)
    real = Path(sys.base_prefix) / "bin" / f"python3.{sys.version_info.minor}"
    (tmp_path / real.name).unlink(missing_ok=True)
    (tmp_path / real.name).symlink_to(real)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("UV_PYTHON_SEARCH_PATH", str(tmp_path))
    found = pythons(UV)
    assert f"3.{sys.version_info.minor}" in found
    assert Path("/nowhere") not in found.values()


def test_all_dependencies_have_an_accepted_licence() -> None:
    """What the lock file has for our packages with all their extras, as far as it is installed here."""
    needed = wheels.needed(wheels.LOCK.read_text(encoding="utf-8"))
    said: list[tuple[str, str]] = []
    for name in needed:
        try:
            said.append((name, licence(distribution(name))))
        except PackageNotFoundError:
            continue
    assert len(said) > 40
    assert not not_permissive(said)
    assert not AS_THEY_ARE.keys() - needed


@pytest.mark.parametrize("text", ["GPL-3.0-only", "says none", "Apache-2.0 AND AGPL-3.0", "LGPL-2.1"])
def test_a_licence_that_asks_for_more_is_noticed(text: str) -> None:
    assert not_permissive([("acme", text)])
    assert not not_permissive([("acme", "MIT"), ("python-can", "LGPL-3.0")])
