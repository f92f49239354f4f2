"""Functions of C libraries as services: the header says what they take, a Python signature says what that means."""

from trade_drivers.clibrary._library import CFunctionFailed, CLibrary

__all__ = ["CFunctionFailed", "CLibrary"]
