"""For those that listen for strangers: a bound on how many of them there are at once."""

from trade._transport.bounded_listener import BoundedListener

__all__ = ["BoundedListener"]
