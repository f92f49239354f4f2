"""Whether all that our packages need can be installed on the computers of robots: Linux on arm64, without a compiler.

    python -m tests.release.wheels

The lock file says what the index has of every package. What is installed on x86_64 only counts, too: it is what
arm64 lacks.
"""

import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

from packaging.markers import Marker
from packaging.tags import Tag, compatible_tags, cpython_tags
from packaging.utils import parse_wheel_filename

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

LOCK: Final = Path(__file__).parents[2] / "uv.lock"
OURS: Final = ("trade-checks", "trade-core", "trade-drivers", "trade-gateway", "trade-hil-sim", "trade-robotfile")
PYTHONS: Final = ((3, 10), (3, 11), (3, 12), (3, 13))
ALLOWED: Final = {"ur-rtde"}
"""Arms of Universal Robots need a computer with x86_64, or a build from source; the rest of a robot does without."""
_PLATFORMS: Final = [f"manylinux_2_{minor}_aarch64" for minor in range(28, 16, -1)] + ["manylinux2014_aarch64"]

Package = Mapping[str, Any]


def lacking(lock: str) -> dict[str, list[str]]:
    """Packages without a wheel for arm64, and the versions of Python that lack it.

    Args:
        lock: text of a uv.lock.
    """
    packages = cast("list[Package]", tomllib.loads(lock)["package"])  # pyright: ignore[reportUnknownMemberType]
    found: dict[str, list[str]] = {}
    for python in PYTHONS:
        version = ".".join(map(str, python))
        tags = frozenset((*cpython_tags(python, platforms=_PLATFORMS), *compatible_tags(python, platforms=_PLATFORMS)))
        for package in _needed(packages, version):
            if not _has_wheel(package, tags):
                found.setdefault(str(package["name"]), []).append(version)
    return found


def needed(lock: str) -> set[str]:
    """Names of all packages that ours need, on one version of Python or another.

    Args:
        lock: text of a uv.lock.
    """
    packages = cast("list[Package]", tomllib.loads(lock)["package"])  # pyright: ignore[reportUnknownMemberType]
    return {str(one["name"]) for major, minor in PYTHONS for one in _needed(packages, f"{major}.{minor}")}


def _needed(packages: Iterable[Package], python: str) -> Iterator[Package]:
    """What our packages need with all their extras, and what that needs."""
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "platform_machine": "x86_64",
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
        "platform_python_implementation": "CPython",
        "implementation_name": "cpython",
    }
    by_name: dict[str, list[Package]] = {}
    for package in packages:
        by_name.setdefault(package["name"], []).append(package)
    seen: set[tuple[str, str]] = set()
    left: list[Mapping[str, Any]] = [{"name": name} for name in OURS]
    while left:
        wanted = left.pop()
        if "marker" in wanted and not Marker(wanted["marker"]).evaluate(environment):
            continue
        for package in by_name[wanted["name"]]:
            at = (package["name"], package["version"])
            if at in seen or wanted.get("version", package["version"]) != package["version"]:
                continue
            seen.add(at)
            left += package.get("dependencies", [])
            if package["name"] in OURS:
                left += [each for extra in package.get("optional-dependencies", {}).values() for each in extra]
            else:
                left += [each for name in wanted.get("extra", []) for each in package["optional-dependencies"][name]]
                yield package


def _has_wheel(package: Package, tags: frozenset[Tag]) -> bool:
    names = (wheel["url"].rpartition("/")[2] for wheel in package.get("wheels", []))
    return any(not tags.isdisjoint(parse_wheel_filename(name)[3]) for name in names)


def main() -> int:
    """Print what is lacking; 1 if that is more than is allowed."""
    found = lacking(LOCK.read_text(encoding="utf-8"))
    for name, pythons in found.items():
        print(f"{name}: no wheel for Linux on arm64 with Python {', '.join(pythons)}")
    return int(found.keys() != ALLOWED)


if __name__ == "__main__":
    sys.exit(main())
