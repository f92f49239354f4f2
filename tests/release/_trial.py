"""One Python: an environment of its own with our wheels and nothing of this folder, and tests of this folder in it."""

import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.release._build import ROOT

_STAND: Final = (
    "tests",
    "docs",
    "examples",
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "Makefile",
    "mkdocs.yml",
    "pyproject.toml",
)
"""What tests read. The packages are not in it: what is imported is what is installed."""
_TOOLS: Final = (
    "pytest",
    "pytest-timeout",
    "pytest-xdist",
    "psutil",
    "hypothesis",
    "packaging",
    "jsonschema-rs",
    "minimalmodbus",
)
_EXTRAS: Final = {
    "trade_core": "metrics,otel",
    "trade_drivers": "all",
    "trade_gateway": "export,foxglove,http,mcp,record,ros",
}
QUICK: Final = (
    "tests/docs/test_docs.py::test_the_readme_program_does_what_it_says",
    "tests/unit/trade/test_wire_vectors.py",
    "tests/unit/trade/test_calls.py",
    "tests/unit/hil_sim/test_bus_sdk.py",
    "tests/unit/drivers/test_robotfile.py",
    "tests/unit/gateway/test_help.py",
    "tests/system/test_transcript.py",
)
"""What shows in a minute that the parts are whole: calls, bytes, simulated servos, robot files, the command line."""


class Failed(Exception):
    """A step that did not go well; with what it said."""


class Trial:
    """The trial of our wheels on one Python."""

    def __init__(self, uv: str, python: Path, wheels: Path, folder: Path) -> None:
        self._uv, self._wheels, self._folder = uv, wheels, folder
        self._python = folder / "env" / "bin" / "python"
        self._run(uv, "venv", "--quiet", "--no-project", "--python", python, folder / "env")
        self._stand = folder / "stand"
        self._stand.mkdir()

    def core_alone(self) -> None:
        """Install the core without the other packages; a program finds its own service."""
        self._install(self._wheel("trade_core"))
        program = "import trade; trade.close(); print(trade.__file__)"
        where = self._run(self._python, "-c", program).strip()
        if not Path(where).is_relative_to(self._folder):
            raise Failed(f"trade was imported from {where}, not from its wheel")

    def all(self) -> str:
        """Install all five with their extras, as one does who trusts their ranges; what the command says of itself."""
        wheels = [f"{self._wheel(name)}[{extras}]" for name, extras in _EXTRAS.items()]
        self._install(*wheels, self._wheel("trade_hil_sim"), self._wheel("trade_checks"))
        self._run(self._uv, "pip", "check", "--quiet", "--python", self._python)
        return self._run(self._python.parent / "trade", "--version").strip()

    def licences(self) -> str:
        """What is installed, with its licences."""
        return self._run(self._python, ROOT / "tests" / "release" / "_licences.py")

    def tests(self, which: Sequence[str]) -> str:
        """Run tests; the last line of what pytest says."""
        self._install(*self._tools())
        for name in _STAND:
            source, target = ROOT / name, self._stand / name
            copy = shutil.copytree if source.is_dir() else shutil.copy2
            copy(source, target)
        log = self._folder / "pytest.txt"
        words = [self._python, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *which]
        with log.open("w", encoding="utf-8") as said:
            code = subprocess.run(
                words, cwd=self._stand, stdout=said, stderr=said, env=self._environment(), check=False
            )
        text = log.read_text(encoding="utf-8")
        if code.returncode:
            raise Failed(text[-6000:])
        return text.strip().splitlines()[-1]

    def _tools(self) -> list[str]:
        """What tests are run with, in the versions of the lock file."""
        words = (self._uv, "export", "--quiet", "--frozen", "--only-group", "dev", "--no-hashes", "--no-annotate")
        pins = [line for line in self._run(*words, at=ROOT).splitlines() if line.partition("==")[0] in _TOOLS]
        return [pin.replace(" ;", ";") for pin in pins]

    def _wheel(self, name: str) -> str:
        [wheel] = self._wheels.glob(f"{name}-*.whl")
        return str(wheel)

    def _install(self, *what: str | Path) -> None:
        self._run(self._uv, "pip", "install", "--quiet", "--compile-bytecode", "--python", self._python, *what)

    def _run(self, *words: str | Path, at: Path | None = None) -> str:
        ended = subprocess.run(
            words,
            cwd=at or self._folder,
            env=self._environment(),
            capture_output=True,
            text=True,
            check=False,
        )
        if ended.returncode:
            raise Failed(f"{' '.join(map(str, words))}\n{ended.stdout}{ended.stderr}")
        return ended.stdout

    def _environment(self) -> dict[str, str]:
        """As a user's, without what points at the environment this runs in."""
        left_out = ("VIRTUAL_ENV", "PYTHONDONTWRITEBYTECODE", "PYTHONPATH", "PYTHONHOME", "UV_PYTHON")
        kept = {name: value for name, value in os.environ.items() if name not in left_out}
        path = os.pathsep.join([str(self._python.parent), kept.get("PATH", "")])
        return {**kept, "PATH": path, "TRADE_SYSTEM": f"release-{os.getpid()}-{time.monotonic_ns()}"}
