"""Command line, bridge and operation of TRADE systems."""

__all__: list[str] = []
