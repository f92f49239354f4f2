"""Clients of a container that acts for others: each a session of its own, and what all of them can have done."""

from trade_gateway.clients._api import Deeds
from trade_gateway.clients._authorizer import ANONYMOUS, Judge
from trade_gateway.clients._clients import Client, Clients, places
from trade_gateway.clients._errors import NoAuditRecord, NoSuchSession, TooMany

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
