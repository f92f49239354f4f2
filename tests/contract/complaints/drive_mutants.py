"""What naive code makes of a drive's scale, units and mapping. Each changes one function."""

from collections.abc import Iterator

import pytest

from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402 import _verify as verify
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.cia402._units import Scale
from trade_drivers.vendors.cia402._wire import Answer, Net


def all_speeds_are_counts(patch: pytest.MonkeyPatch) -> None:
    def counts(axis: DriveAxis, *_: object) -> float:
        return axis.resolution.rad

    patch.setattr("trade_drivers.vendors.cia402._units._unit_in_rad", counts)


def the_file_alone_has_the_scale(patch: pytest.MonkeyPatch) -> None:
    def unread(*_: object) -> Answer[Scale]:
        yield
        return Scale(None, "", 1.0, 1.0)

    patch.setattr("trade_drivers.vendors.cia402._units.read_scale", unread)


def a_drive_is_mapped_in_any_state(patch: pytest.MonkeyPatch) -> None:
    def at_once(net: Net, axis: DriveAxis) -> Iterator[None]:
        yield from verify._map(net, axis.id, table.STATUS, 1, table.NO_REMOTE)

    patch.setattr(verify, "_map_first", at_once)


def a_full_queue_is_a_lost_port(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_drivers.bus.can._port.is_full", lambda _: False)
