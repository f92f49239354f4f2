"""brltty takes CH340 and CP210x adapters away; `trade doctor` names it and its rule, and only where it is active."""

from pathlib import Path

import pytest

from trade_gateway.cli.hardware._doctor_brltty import brltty
from trade_gateway.cli.hardware._doctor_host import Finding

RULES = """\
ACTION!="add", GOTO="brltty_usb_end"
SUBSYSTEM!="usb", GOTO="brltty_usb_end"
ENV{DEVTYPE}!="usb_device", GOTO="brltty_usb_end"

# Device: 0403:6001
ENV{PRODUCT}=="403/6001/*", ATTR{manufacturer}=="Braille Ltd", ENV{BRLTTY_BRAILLE_DRIVER}="hd", GOTO="brltty_usb_run"
# Device: 1A86:7523
ENV{PRODUCT}=="1a86/7523/*", ENV{BRLTTY_BRAILLE_DRIVER}="bm", \\
  GOTO="brltty_usb_run"
# Device: 10C4:EA60
ENV{PRODUCT}=="10c4/ea60/*", ENV{BRLTTY_BRAILLE_DRIVER}="sk", GOTO="brltty_usb_run"
GOTO="brltty_usb_end"

LABEL="brltty_usb_run"
TAG+="systemd", ENV{SYSTEMD_WANTS}="brltty-udev.service"
LABEL="brltty_usb_end"
"""
OTHER_FORM = 'ATTRS{idVendor}=="1a86", ATTRS{idProduct}=="7523|55d3", RUN+="/usr/bin/brltty -E"\n'


class Host:
    """The folders of a host that the check reads."""

    def __init__(self, folder: Path) -> None:
        self.devices, self.program, self.units = folder / "devices", folder / "bin" / "brltty", folder / "units"
        self.etc, self.lib = folder / "etc" / "udev" / "rules.d", folder / "lib" / "udev" / "rules.d"
        for made in (self.devices, self.program.parent, self.units, self.etc, self.lib):
            made.mkdir(parents=True)
        self.program.touch()
        self.rules = self.lib / "85-brltty.rules"
        self.rules.write_text(RULES)

    def plug(self, ids: str, tty: str = "", manufacturer: str = "") -> None:
        device = self.devices / f"1-{len(list(self.devices.iterdir())) + 1}"
        (device / f"{device.name}:1.0" / tty).mkdir(parents=True)
        vendor, _, product = ids.partition(":")
        for name, value in (("idVendor", vendor), ("idProduct", product), ("bcdDevice", "0264")):
            (device / name).write_text(f"{value}\n")
        if manufacturer:
            (device / "manufacturer").write_text(f"{manufacturer}\n")

    def check(self) -> list[Finding]:
        return list(brltty(self.devices, (self.etc, self.lib), (self.program,), (self.units,)))


@pytest.fixture
def host(tmp_path: Path) -> Host:
    return Host(tmp_path)


@pytest.mark.parametrize(
    ("ids", "chip", "line"), [("1a86:7523", "CH340", 8), ("10c4:ea60", "CP210x", 11)], ids=["CH340", "CP210x"]
)
def test_an_adapter_that_brltty_has_taken_is_an_error_with_the_rules_file(
    host: Host, ids: str, chip: str, line: int
) -> None:
    host.plug(ids)
    [found] = host.check()
    assert (found.level, found.about) == ("error", f"{chip} adapter {ids}")
    assert f"brltty takes it away: {host.rules}, line {line}," in found.text
    assert "sudo apt remove brltty" in found.fix


def test_an_adapter_that_still_has_its_port_is_a_warning(host: Host) -> None:
    host.plug("1a86:7523", tty="ttyUSB0")
    [found] = host.check()
    assert (found.level, "brltty may take it away" in found.text) == ("warning", True)


def test_rules_of_another_form_count_too(host: Host) -> None:
    host.rules.write_text(OTHER_FORM)
    host.plug("1a86:55d3")
    assert [found.level for found in host.check()] == ["error"]


def test_an_ftdi_adapter_is_covered_only_by_its_manufacturer(host: Host) -> None:
    host.plug("0403:6001", manufacturer="FTDI")
    assert host.check() == []
    host.plug("0403:6001", manufacturer="Braille Ltd")
    assert len(host.check()) == 1


def test_an_adapter_that_no_rule_names_and_a_braille_display_are_not_reported(host: Host) -> None:
    host.plug("0403:6014")
    host.plug("1fe4:0044")  # a display: of no vendor of serial chips
    host.rules.write_text(RULES + 'ENV{PRODUCT}=="1fe4/44/*", ENV{BRLTTY_BRAILLE_DRIVER}="ht"\n')
    assert host.check() == []


def commented(host: Host) -> None:
    host.rules.write_text(RULES.replace('ENV{PRODUCT}=="1a86', '#ENV{PRODUCT}=="1a86'))


def overridden(host: Host) -> None:
    (host.etc / host.rules.name).symlink_to("/dev/null")


def masked(host: Host) -> None:
    (host.units / "brltty-udev.service").symlink_to("/dev/null")


def removed(host: Host) -> None:
    host.program.unlink()


@pytest.mark.parametrize("change", [commented, overridden, masked, removed])
def test_a_rule_that_is_not_active_is_not_reported(host: Host, change: object) -> None:
    host.plug("1a86:7523")
    assert len(host.check()) == 1
    assert callable(change)
    change(host)
    assert host.check() == []


def test_a_copy_in_etc_is_the_one_that_counts(host: Host) -> None:
    (host.etc / host.rules.name).write_text(RULES)
    host.plug("1a86:7523")
    assert f"{host.etc / host.rules.name}, line" in host.check()[0].text
