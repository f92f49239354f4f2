"""`trade stubs`: the services of a group as Python classes, for type checkers and editors."""

from trade_gateway.stubs._module import write_stubs

__all__ = ["write_stubs"]
