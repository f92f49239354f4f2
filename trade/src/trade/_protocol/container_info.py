"""What one container knows of another."""

from msgspec import Struct

from trade._protocol.messages import PROTOCOL


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
    """The version that it speaks; 0 before it has said anything to the one that tells of it. If it is another one than
    that one's, nothing of what it offers is known there."""
