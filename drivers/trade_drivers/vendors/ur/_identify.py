"""Identification of a controller's arm, by queries only."""

import re
from typing import Final

from trade.errors import ConfigurationError
from trade_drivers.commissioning._commissioner import Found
from trade_drivers.vendors.ur._dashboard import DashboardError, ask, probe

_ASK_S: Final = 2.0
_VERSION: Final = re.compile(r"(\d+)\.\d+(?:\.\d+)*")
_E_SERIES: Final = 5
"""First digit of the e-Series' software version; the CB3's is 3."""


def identify(host: str) -> Found:
    """Returns a controller's arm: model, software version, serial number.

    Raises:
        ConfigurationError: nothing answers, or it is not a controller.
    """
    try:
        probe(host, _ASK_S)
        model = ask(host, "get robot model", _ASK_S)
        version = _VERSION.search(ask(host, "PolyscopeVersion", _ASK_S))
        serial_number = ask(host, "get serial number", _ASK_S)
    except DashboardError as bad:
        raise ConfigurationError(where=host, problem=f"no controller of an arm answers: {bad}") from None
    e_series = version is not None and int(version[1]) >= _E_SERIES
    return Found(
        driver="ur",
        kind="arm",
        model=f"{model.rstrip('e')}e" if e_series else model,
        firmware=version[0] if version else "",
        serial_number=int(serial_number) if serial_number.isdecimal() else None,
    )
