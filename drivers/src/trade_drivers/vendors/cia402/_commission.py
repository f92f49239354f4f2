"""Who is on a CAN bus: drives with their node ids. Those are set by switches or the vendor's tool, not from here."""

from trade.errors import ConfigurationError
from trade_drivers.commissioning._commissioner import Bench, Commissioner

__all__ = ["Cia402Commissioner"]


class Cia402Commissioner(Commissioner):
    """CiA 402 drives on a CAN bus, given as ``INTERFACE:CHANNEL``."""

    driver = "cia402"
    wire = "can"
    bauds = (1_000_000,)
    """The system sets the rate of an interface; frames at another one would disturb who talks there."""
    ids = range(1, 127)
    ports = "is the interface up? `ip link show type can` shows those there are"

    def open(self, port: str, baud: int) -> Bench:
        try:
            from trade_drivers.vendors.cia402._scan import DriveBench  # noqa: PLC0415 - the libraries are optional
        except ImportError as missing:
            problem = f'needs canopen and python-can ({missing}); pip install "trade-drivers[cia402]"'
            raise ConfigurationError(where="driver cia402", problem=problem) from None
        return DriveBench.open(port, baud)
