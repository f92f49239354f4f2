"""The object dictionary, written twice on purpose: the simulator's and the driver's tables agree."""

import pytest

from trade_drivers.vendors.cia402 import _table as theirs
from trade_hil_sim.cia402 import OBJECTS

pytestmark = pytest.mark.virtual_time

OURS = {(entry.index, entry.sub): entry for entry in OBJECTS}


def entries() -> list[theirs.DictionaryEntry]:
    """Every object the driver's table names, alone or in a row."""
    found: list[theirs.DictionaryEntry] = []
    for value in vars(theirs).values():
        row = value if isinstance(value, tuple) else (value,)
        found += [entry for entry in row if isinstance(entry, theirs.DictionaryEntry)]
    return found


def test_the_drivers_table_is_found() -> None:
    assert len(entries()) > 20


@pytest.mark.parametrize("entry", entries(), ids=str)
def test_an_object_the_driver_uses_is_simulated_with_its_size_and_sign(entry: theirs.DictionaryEntry) -> None:
    ours = OURS[entry.index, entry.sub]
    assert (ours.size, ours.signed) == (entry.size, entry.kind[0] == "i")
