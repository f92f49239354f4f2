"""A system file as the gateway file of its supervisor: the containers of this host that `trade gateway` keeps up."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from trade.errors import ConfigurationError
from trade_gateway.config._entry import LOCAL
from trade_gateway.config._toml_file import at

_OF_GATEWAY = ("tls", "policy", "audit", "connect")
"""Keys of ``[system]`` that its supervisor takes, too."""


def as_gateway(path: Path, text: str, raw: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the contents of a file as those of a gateway file; another file than a system file is left as it is.

    Raises:
        ConfigurationError: it is a system file without a supervisor.
    """
    system = raw.get("system")
    if not isinstance(system, dict):
        return raw
    settings, tables = cast("dict[str, Any]", system), raw.get("container")
    if not settings.get("supervisor"):
        problem = 'this is a system file; run `trade system up`, or write supervisor = "keeper" here'
        raise ConfigurationError(where=at(path, text, ("system",), ""), problem=problem)
    own = {key: settings[key] for key in _OF_GATEWAY if key in settings}
    defaults = {"connect": settings["connect"]} if settings.get("connect") else {}
    containers = {
        name: {**defaults, **table}
        for name, table in (cast("dict[str, Any]", tables) if isinstance(tables, dict) else {}).items()
        if is_supervised(table)
    }
    return {"system": settings.get("name"), "name": settings.get("supervisor"), **own, "container": containers}


def is_supervised(table: object) -> bool:
    """Whether a table of a system file with a supervisor is one of its containers."""
    if not isinstance(table, dict):
        return True  # the reader of tables refuses it
    entry = cast("dict[str, Any]", table)
    return entry.get("host", LOCAL) == LOCAL and not entry.get("gateway")
