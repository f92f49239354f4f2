"""Clients of the HTTP gateway and of agents: each has its own session, and `ClientApi` executes their requests."""

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
