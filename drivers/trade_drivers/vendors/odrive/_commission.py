"""Scanning a CAN bus for ODrives by the frames that they send by themselves."""

from typing import TYPE_CHECKING

from trade_drivers.joints.can._commission import CanMotorCommissioner
from trade_drivers.vendors.odrive._frames import NODES

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench


class OdriveCommissioner(CanMotorCommissioner):
    """ODrives; one without a node number is shown with the number 63."""

    driver = "odrive"
    ids = range(NODES + 1)

    def bench(self) -> "type[CanBench]":
        from trade_drivers.vendors.odrive._scan import OdriveBench  # noqa: PLC0415 - python-can is optional

        return OdriveBench
