"""Clients of a container that acts for others: each a session of its own, and what all of them can have done."""

from trade_gateway.clients._api import ClientApi
from trade_gateway.clients._authorizer import ANONYMOUS, ClientAuthorizer
from trade_gateway.clients._clients import Client, Clients, places
from trade_gateway.clients._errors import NoAuditRecord, NoSuchSession, TooMany

__all__ = [
    "ANONYMOUS",
    "Client",
    "ClientApi",
    "ClientAuthorizer",
    "Clients",
    "NoAuditRecord",
    "NoSuchSession",
    "TooMany",
    "places",
]
