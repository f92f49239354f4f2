"""Which Damiao motors are on a CAN bus: each is asked for what its numbers mean."""

from typing import TYPE_CHECKING

from trade_drivers.joints.can._commission import CanMotorCommissioner
from trade_drivers.vendors.damiao._frames import MASTER

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench

__all__ = ["DamiaoCommissioner"]


class DamiaoCommissioner(CanMotorCommissioner):
    """Damiao motors; they leave the factory with number 1 and without one of their own to answer with."""

    driver = "damiao"
    ids = range(1, MASTER)

    def bench(self) -> "type[CanBench]":
        from trade_drivers.vendors.damiao._scan import DamiaoBench  # noqa: PLC0415 - python-can is optional

        return DamiaoBench
