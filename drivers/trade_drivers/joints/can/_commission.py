"""Scanning a CAN bus for motors, whose ids only the vendor's tool can set."""

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from trade_drivers._validation import not_installed
from trade_drivers.commissioning._commissioner import Bench, Commissioner

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench


class CanMotorCommissioner(Commissioner):
    """Motors on a CAN bus, given as ``INTERFACE:CHANNEL``."""

    wire = "can"
    bauds = (1_000_000,)
    """The system sets the rate of an interface; frames at another rate would disturb the bus."""
    libraries: ClassVar[str] = "python-can"
    ports = "is the interface up? `ip link show type can` lists the interfaces"

    @abstractmethod
    def bench(self) -> "type[CanBench]":
        """Returns the class of its bench; raises ImportError if a library is missing."""

    def open(self, port: str, baud: int) -> Bench:
        try:
            bench = self.bench()
        except ImportError as missing:
            raise not_installed(self.driver, self.libraries, missing) from None
        return bench.open(port, baud)
