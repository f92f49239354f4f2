"""The control tables against the vendor's own and against an independent client's."""

from pathlib import Path

import dynamixel_easy_sdk
import pytest
import rustypot

from trade_hil_sim.dynamixel import MODELS, XL430_W250, Model

FILES = Path(dynamixel_easy_sdk.__file__).parent / "control_table"


def vendor_table(name: str) -> dict[str, tuple[int, int]]:
    """Address and size by name, as the vendor's wheel ships them."""
    text = (FILES / f"{name.lower().replace('-', '_')}.model").read_text()
    lines = text.partition("[control table]")[2].strip().splitlines()[1:]
    rows = [line.split("\t") for line in lines if line.strip()]
    return {name: (int(address), int(size)) for address, size, name in rows}


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_every_register_of_the_vendors_table_is_ours_at_its_address_and_size(model: Model) -> None:
    ours = {(register.address, register.size) for register in model.registers}
    vendors = vendor_table(model.name)
    assert set(vendors.values()) <= ours
    named = {_key(r.name): (r.address, r.size) for r in model.registers}
    for name, where in vendors.items():
        if "Indirect" not in name:
            assert named[_key(name)] == where


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_the_vendor_files_the_model_number_under_this_name(model: Model) -> None:
    rows = [line.split() for line in (FILES / "dynamixel.model").read_text().splitlines()[1:]]
    assert dict(rows)[str(model.number)] == f"{model.name.lower().replace('-', '_')}.model"


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_an_independent_client_knows_the_same_registers_and_accesses(model: Model) -> None:
    ours = {register.address: register for register in model.registers}
    for theirs in rustypot.Xl430PyController.registers():
        if theirs.addr in {38, 102} and model is XL430_W250:
            continue  # its table serves the whole family; only the XM has current control
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


def _key(name: str) -> str:
    return name.lower().replace(" ", "_").replace("secondary(shadow)_id", "shadow_id")
