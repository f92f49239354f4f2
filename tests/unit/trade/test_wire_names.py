"""Types that results consist of are named on the wire: a name there outlives a move of its module."""

import importlib
import inspect
import pkgutil
import typing
from collections.abc import Iterator

import pytest

import trade
import trade_drivers
import trade_gateway
from trade._services.decorator import effect_of
from trade._services.description import _types_in
from trade.protocol.schema_types import imported, name_of

pytest.importorskip("mcp")


def modules() -> Iterator[str]:
    for package in (trade, trade_drivers, trade_gateway):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.endswith("__main__") and "._node" not in found.name and ".testing" not in found.name:
                yield found.name


def results() -> dict[str, type]:
    """By name, the types in the results of all services of the product."""
    found: dict[str, type] = {}
    for name in modules():
        module = importlib.import_module(name)
        for _, kind in inspect.getmembers(module, inspect.isclass):
            for function in vars(kind).values() if kind.__module__.startswith("trade") else ():
                if not inspect.isfunction(function) or effect_of(function) is None:
                    continue
                hints = typing.get_type_hints(function, include_extras=True)
                found |= {name_of(each): each for each in _types_in(hints.get("return"), set())}
    return {name: kind for name, kind in found.items() if name.startswith("trade")}


def test_no_private_module_is_named_on_the_wire() -> None:
    named = results()
    assert len(named) > 30
    assert [name for name in named if "._" in name.partition(":")[0]] == []


def test_a_type_is_found_under_its_name() -> None:
    assert {name: imported(name) for name in results()} == results()
