"""The check of ``trade doctor`` for brltty: a program for braille displays, some of which have a common serial chip.

When such a chip is plugged in, a udev rule starts brltty, which takes the adapter away from its serial driver.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple

from trade_gateway.cli.hardware._doctor_host import Finding

_DEVICES: Final = Path("/sys/bus/usb/devices")
_RULES: Final = tuple(Path(folder, "udev/rules.d") for folder in ("/etc", "/run", "/usr/local/lib", "/usr/lib", "/lib"))
"""Where udev finds rules (man 7 udev): a file replaces those of the same name in later folders."""
_PROGRAMS: Final = tuple(Path(folder, "brltty") for folder in ("/usr/bin", "/bin", "/usr/sbin", "/sbin"))
_UNITS: Final = (Path("/etc/systemd/system"), Path("/run/systemd/system"))
_UNIT: Final = "brltty-udev.service"
"""What its rules start; masked, it does not start."""
_CHIPS: Final = {"1a86": "CH340", "10c4": "CP210x", "0403": "FTDI", "067b": "PL2303"}
"""Vendors of serial chips, by their USB ids; other devices of its rules are braille displays."""
_TERM: Final = re.compile(r'([A-Z]+(?:\{[^}]*\})?)\s*(==|!=|\+=|:=|-=|=)\s*"([^"]*)"')


class _Place(NamedTuple):
    """A line of a file of rules."""

    path: Path
    line: int


def brltty(
    devices: Path = _DEVICES,
    rules: Sequence[Path] = _RULES,
    programs: Sequence[Path] = _PROGRAMS,
    units: Sequence[Path] = _UNITS,
) -> Iterator[Finding]:
    """Checks whether brltty takes a serial adapter away that is plugged in.

    Args:
        devices: folder of the USB devices.
        rules: folders of udev rules, the first one first.
        programs: where brltty may be installed.
        units: folders where its systemd unit may be masked.
    """
    if not any(map(Path.exists, programs)) or any(_is_masked(folder / _UNIT) for folder in units):
        return
    lines = list(_lines(rules))
    for device in sorted(devices.glob("*")):
        about = _attributes(device)
        chip = _CHIPS.get(about["idVendor"])
        covered = next((place for place, line in lines if chip and _starts_brltty(line, about)), None)
        if covered is None:
            continue
        name = f"{chip} adapter {about['idVendor']}:{about['idProduct']}"
        if any(chain(device.glob("*:*/ttyUSB*"), device.glob("*:*/tty/tty*"))):
            text = f"brltty may take it away: {covered.path}, line {covered.line}, starts brltty for it"
            yield Finding(level="warning", about=name, text=text, fix=_fix(covered))
        else:
            text = f"it has no port; brltty takes it away: {covered.path}, line {covered.line}, starts brltty for it"
            yield Finding(level="error", about=name, text=text, fix=_fix(covered))


def _fix(covered: _Place) -> str:
    here = covered.path.parent.is_relative_to("/etc")
    delete = f"delete that line{'' if here else f' in a copy of the file in {_RULES[0]}'}"
    return f"sudo apt remove brltty; or, if a braille display needs it, {delete}. Then plug the adapter in again"


def _is_masked(unit: Path) -> bool:
    return unit.is_symlink() and unit.resolve() == Path("/dev/null")


def _lines(folders: Sequence[Path]) -> Iterator[tuple[_Place, str]]:
    """Yields the rules that udev reads: of each name, those of the first folder that has it."""
    files: dict[str, Path] = {}
    for folder in folders:
        for path in sorted(folder.glob("*.rules")):
            files.setdefault(path.name, path)
    for path in files.values():
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError:  # not for this user to read, or gone
            continue
        number = 1
        for line in text.replace("\\\n", "\0").split("\n"):  # a rule may go on in the next line
            if not line.lstrip().startswith("#"):
                yield _Place(path, number), line
            number += 1 + line.count("\0")


def _attributes(device: Path) -> dict[str, str]:
    """Returns the attributes of a USB device that rules compare, and ``PRODUCT`` as udev has it."""
    known = {name: _read(device / name) for name in ("idVendor", "idProduct", "bcdDevice", "manufacturer", "product")}
    numbers = (known[name].lstrip("0") or "0" for name in ("idVendor", "idProduct", "bcdDevice"))
    return known | {"PRODUCT": "/".join(numbers)}


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _starts_brltty(rule: str, about: Mapping[str, str]) -> bool:
    """Whether a rule assigns a device with these attributes to brltty."""
    named = assigned = False
    for key, operator, value in _TERM.findall(rule):
        name = key.partition("{")[2].rstrip("}") if key.startswith(("ATTR", "ENV")) else ""
        if operator in {"==", "!="}:
            if name in about:
                matches = any(fnmatchcase(about[name], pattern) for pattern in value.split("|"))
                if matches != (operator == "=="):
                    return False
                named = named or name in {"PRODUCT", "idVendor"}
        elif key != "GOTO":
            assigned = assigned or "brltty" in f"{key} {value}".lower()
    return named and assigned
