"""Who is on a CAN bus of motors; their numbers are set by the vendor's tool, not from here."""

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from trade_drivers._validation import not_installed
from trade_drivers.commissioning._commissioner import Bench, Commissioner

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench

__all__ = ["CanMotorCommissioner"]


class CanMotorCommissioner(Commissioner):
    """Motors on a CAN bus, given as ``INTERFACE:CHANNEL``."""

    wire = "can"
    bauds = (1_000_000,)
    """The system sets the rate of an interface; frames at another one would disturb who talks there."""
    libraries: ClassVar[str] = "python-can"
    ports = "is the interface up? `ip link show type can` shows those there are"

    @abstractmethod
    def bench(self) -> "type[CanBench]":
        """Raises ImportError where a library is missing."""

    def open(self, port: str, baud: int) -> Bench:
        try:
            bench = self.bench()
        except ImportError as missing:
            raise not_installed(self.driver, self.libraries, missing) from None
        return bench.open(port, baud)
