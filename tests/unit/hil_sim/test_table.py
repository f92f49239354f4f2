"""The control tables against the vendor's own and against an independent client's."""

from pathlib import Path

import dynamixel_easy_sdk
import pytest
import rustypot

from trade_hil_sim.dynamixel import MODELS, Model

pytestmark = pytest.mark.virtual_time

FILES = Path(dynamixel_easy_sdk.__file__).parent / "control_table"


def vendor_table(name: str) -> dict[str, tuple[int, int]]:
    """Address and size by name, as the vendor's wheel ships them."""
    text = (FILES / f"{_file(name)}{'_fw52' if '330-' in name else ''}.model").read_text()
    lines = text.partition("[control table]")[2].strip().splitlines()[1:]
    rows = [line.split("\t") for line in lines if line.strip()]
    return {name: (int(address), int(size)) for address, size, name in rows}


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_the_simulator_has_every_register_of_the_vendors_table_at_its_address_and_size(model: Model) -> None:
    ours = {(register.address, register.size) for register in model.registers}
    vendors = vendor_table(model.name)
    assert set(vendors.values()) <= ours
    named = {_key(r.name): (r.address, r.size) for r in model.registers}
    for name, where in vendors.items():
        if "Indirect" not in name:
            assert named[_key(name)] == where


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_the_vendor_files_the_model_number_under_this_name(model: Model) -> None:
    rows = dict(line.split() for line in (FILES / "dynamixel.model").read_text().splitlines()[1:])
    if model.name == "XW430-T200":  # its table exists, but the list of numbers leaves it out
        assert str(model.number) not in rows
    else:
        assert rows[str(model.number)] == f"{_file(model.name)}.model"


def test_the_vendor_knows_no_other_servo_of_these_series() -> None:
    rows = dict(line.split() for line in (FILES / "dynamixel.model").read_text().splitlines()[1:])
    theirs = {number for number, file in rows.items() if file.startswith(("x", "2x", "mx")) and file != "xl320.model"}
    assert theirs | {"1280"} == {str(model.number) for model in MODELS.values()}


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_an_independent_client_knows_the_same_registers_and_accesses(model: Model) -> None:
    ours = {register.address: register for register in model.registers}
    left_out = set(range(168, 230)) if "330-" in model.name else set[int]()  # the older firmware's
    left_out |= set() if "current_limit" in model.by_name else {38, 102}  # its table serves all families
    left_out |= set() if "led" in model.by_name else {65}
    for theirs in rustypot.Xl430PyController.registers():
        if theirs.addr in left_out:
            continue
        register = ours[theirs.addr]
        assert register.size == theirs.size, theirs
        assert register.writable == (theirs.access != rustypot.RegisterAccess.Read), theirs


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_registers_do_not_overlap_and_defaults_are_in_range(model: Model) -> None:
    end = 0
    for register in model.registers:
        assert register.address >= end, register
        end = register.address + register.size
        if register.writable and register.high is not None and register.name != "shadow_id":
            assert (register.low or 0) <= register.default <= register.high, register


def _file(model: str) -> str:
    return model.lower().replace("-", "_")


def _key(name: str) -> str:
    return name.lower().replace(" ", "_").replace("secondary(shadow)_id", "shadow_id")
