"""The image: what can be said of it without an engine, and where one answers, that it builds and runs the demo."""

import fnmatch
import os
import re
import secrets
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "Containerfile").read_text(encoding="utf-8")
BUILDS_S, RUNS_S, ANSWERS_S = 900, 300, 20


def instructions() -> list[tuple[str, str]]:
    """Name and rest of each."""
    joined = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", TEXT, flags=re.MULTILINE))
    return [(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in joined.splitlines() if line)]


def of(name: str) -> list[str]:
    return [rest for known, rest in instructions() if known == name]


def copied() -> list[str]:
    """What is taken from this folder."""
    words = [rest.split() for rest in of("COPY")]
    return [source for rest in words if not rest[0].startswith("--from") for source in rest[:-1]]


def test_the_files_that_the_containerfile_copies_exist_and_are_not_ignored() -> None:
    lines = (ROOT / ".containerignore").read_text(encoding="utf-8").splitlines()
    let_in = {line.removeprefix("!") for line in lines if line.startswith("!")}
    assert "*" in lines
    assert set(copied()) == let_in
    assert all((ROOT / source).exists() for source in copied())
    assert (ROOT / ".dockerignore").samefile(ROOT / ".containerignore")


def test_no_key_of_this_folder_gets_in() -> None:
    lines = (ROOT / ".containerignore").read_text(encoding="utf-8").splitlines()
    kept_out = [line.removeprefix("**/") for line in lines if line.startswith("**/")]
    for name in ("key.pem", "ca.key", "pki"):
        assert any(fnmatch.fnmatch(name, pattern) for pattern in kept_out), name


def test_its_base_is_pinned_and_one_this_project_supports() -> None:
    bases = {rest.split()[0] for rest in of("FROM")}
    assert len(bases) == 1
    pinned = re.fullmatch(r"docker\.io/library/python:3\.(\d+)\.\d+-slim-\w+(@sha256:[0-9a-f]{64})?", bases.pop())
    assert pinned
    assert 10 <= int(pinned[1]) <= 13


def test_it_runs_as_a_user_without_rights_and_is_the_command_trade() -> None:
    [user] = of("USER")
    names = [name for name, _ in instructions()]
    assert re.search(rf"useradd .*--uid [1-9]\d+ .*\b{user}\b", " ".join(of("RUN")))
    assert names.index("USER") > max(at for at, name in enumerate(names) if name in ("RUN", "COPY"))
    assert of("ENTRYPOINT") == ['["trade"]']


def test_it_is_built_with_the_uv_of_this_project_and_from_its_lock() -> None:
    [version] = re.findall(r"'uv==([\d.]+)'", (ROOT / "Makefile").read_text(encoding="utf-8"))
    [install, sync, *_] = of("RUN")
    assert f"'uv=={version}'" in install
    assert "sync --locked --no-dev --group robot --no-editable" in sync


def engine() -> str | None:
    """A container engine that answers."""
    for name in ("podman", "docker"):
        if shutil.which(name):
            asked = [name, "version", "--format", "{{.Server.Version}}"] if name == "docker" else [name, "info"]
            try:
                if subprocess.run(asked, capture_output=True, timeout=ANSWERS_S, check=False).returncode == 0:
                    return name
            except subprocess.TimeoutExpired:
                continue
    return None


@pytest.mark.timeout(BUILDS_S + RUNS_S + 60)
def test_the_image_builds_and_runs_the_demo() -> None:
    name = engine()
    if name is None:
        pytest.skip("no container engine answers")
    tag = f"trade-test:{secrets.token_hex(4)}"
    built = subprocess.run(
        [name, "build", "--file", "Containerfile", "--tag", tag, "."],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=BUILDS_S,
        check=False,
    )
    assert built.returncode == 0, built.stderr[-2000:]
    try:
        words = [name, "run", "--rm", "--network", "none", "--entrypoint", "python", tag]
        ended = subprocess.run(
            [*words, "/opt/trade/share/examples/demo.py", "--loopback"],
            capture_output=True,
            text=True,
            timeout=RUNS_S,
            check=False,
        )
        assert ended.returncode == 0, ended.stdout[-1000:] + ended.stderr[-1000:]
    finally:
        subprocess.run([name, "rmi", "--force", tag], capture_output=True, timeout=60, check=False)


@pytest.mark.realtime
def test_the_demo_installs_what_it_uses() -> None:
    uv = os.environ.get("UV", "uv")
    words = [uv, "export", "--quiet", "--frozen", "--no-hashes", "--no-annotate", "--no-dev", "--group"]

    def installed(group: str) -> set[str]:
        listed = subprocess.run([*words, group], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return set(re.findall(r"^([a-z][\w.-]*)==", listed, re.MULTILINE))

    unused = {"pyarrow", "foxglove-sdk", "numpy", "opentelemetry-sdk", "rosbags", "mcp"}
    assert unused <= installed("robot")
    assert not unused & installed("demo")
    assert {"eclipse-zenoh", "dynamixel-sdk", "uvicorn"} <= installed("demo")
