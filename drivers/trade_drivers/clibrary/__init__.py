"""Functions of C libraries as services: a C header declares them, a Python signature defines their types."""

from trade_drivers.clibrary._library import CFunctionFailed, CLibrary

__all__ = ["CFunctionFailed", "CLibrary"]
