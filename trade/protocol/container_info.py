"""The description of a container that other containers keep."""

from msgspec import Struct

from trade.protocol.messages import PROTOCOL


class ContainerInfo(Struct, frozen=True):
    """One container as another one knows it."""

    name: str
    identity: str
    epoch: str
    host: str
    pid: int
    providers: int
    services: int
    protocol: int = PROTOCOL
    """The protocol version that it speaks; 0 before its first message to the container that reports it. If the versions
    of the two differ, the services of the one are unknown to the other."""
