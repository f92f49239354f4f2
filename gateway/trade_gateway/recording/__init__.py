"""Recordings of a system as MCAP files: measurements, calls, locks and faults; recorded, read, replayed, exported."""

from importlib import import_module

from trade.errors import ConfigurationError

__all__ = ["require"]


def require(library: str, extra: str) -> None:
    """Raises ConfigurationError: a library of an extra is not installed."""
    try:
        import_module(library)
    except ImportError:
        problem = f'needs {library}. Run `pip install "trade-gateway[{extra}]"`'
        raise ConfigurationError(where="recordings", problem=problem) from None
