"""The example in the docstring of each driver is a robot file that the driver takes."""

import inspect
import textwrap
from importlib.metadata import entry_points

import pytest

from trade_drivers import parse
from trade_drivers.plugins._driver import Driver, SenseDriver
from trade_drivers.plugins._validate import check

DRIVERS = {
    entry.name: entry for entry in entry_points(group="trade.drivers") if entry.value.startswith("trade_drivers.")
}


@pytest.mark.parametrize("name", sorted(DRIVERS))
def test_the_example_of_a_driver_is_a_robot_file_that_it_takes(name: str) -> None:
    kind: type[Driver] | type[SenseDriver] = DRIVERS[name].load()
    doc = inspect.getdoc(kind) or ""
    example = textwrap.dedent(doc.partition("In a robot file::\n")[2])
    robot = parse(f'[robot]\nname = "rosie"\n{example}', f"{name}.toml")
    assert f'driver = "{name}"' in example
    check(robot, None)
