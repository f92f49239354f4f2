"""The list of containers, as the registry knows them."""

from typing import Final

from trade._registry.registry import Registry
from trade._table import Table
from trade.protocol.container_info import ContainerInfo

_COLUMNS: Final = {
    "CONTAINER": "name",
    "IDENTITY": "identity",
    "HOST": "host",
    "PID": "pid",
    "SERVICES": "services",
    "EPOCH": "epoch",
}


def containers_of(registry: Registry) -> Table[ContainerInfo]:
    """The containers of the system, the own one included."""
    infos = Table[ContainerInfo]((), _COLUMNS)
    for state in registry.containers():
        records = [record for entry in list(state.providers.values()) for record in entry.records]
        first = records[0] if records else None
        infos.append(
            ContainerInfo(
                name=state.address.container,
                identity=state.address.identity,
                epoch=state.address.epoch,
                host=first.host if first else "",
                pid=first.pid if first else 0,
                providers=len(state.providers),
                services=len(records),
                protocol=state.protocol,
            )
        )
    return infos
