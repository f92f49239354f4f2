"""Clients of a container that acts for others: each a session of its own, and what all of them can have done."""

from trade_gateway.clients._clients import Client, Clients, places
from trade_gateway.clients._deeds import Deeds
from trade_gateway.clients._errors import NoAuditRecord, NoSuchSession, TooMany
from trade_gateway.clients._judge import ANONYMOUS, Judge

__all__ = [
    "ANONYMOUS",
    "Client",
    "Clients",
    "Deeds",
    "Judge",
    "NoAuditRecord",
    "NoSuchSession",
    "TooMany",
    "places",
]
