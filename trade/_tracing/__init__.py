"""Traces of the whole system: spans and log lines of all containers, and the services that give them."""
