"""Scanning a CAN bus for Damiao motors, by requests for the ranges of their values."""

from typing import TYPE_CHECKING

from trade_drivers.joints.can._commission import CanMotorCommissioner
from trade_drivers.vendors.damiao._frames import MASTER

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench


class DamiaoCommissioner(CanMotorCommissioner):
    """Damiao motors; factory default: id 1, and no answer id of their own."""

    driver = "damiao"
    ids = range(1, MASTER)

    def bench(self) -> "type[CanBench]":
        from trade_drivers.vendors.damiao._scan import DamiaoBench  # noqa: PLC0415 - python-can is optional

        return DamiaoBench
