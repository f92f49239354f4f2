"""A listening socket with a limit on connections from strangers."""

from trade._transport.bounded_listener import BoundedListener

__all__ = ["BoundedListener"]
