"""Scanning a CAN bus for drives, whose node ids only switches or the vendor's tool can set."""

from typing import TYPE_CHECKING

from trade_drivers.joints.can._commission import CanMotorCommissioner

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench


class Cia402Commissioner(CanMotorCommissioner):
    """CiA 402 drives on a CAN bus, given as ``INTERFACE:CHANNEL``."""

    driver = "cia402"
    libraries = "canopen and python-can"
    ids = range(1, 127)

    def bench(self) -> "type[CanBench]":
        from trade_drivers.vendors.cia402._scan import DriveBench  # noqa: PLC0415 - the libraries are optional

        return DriveBench
