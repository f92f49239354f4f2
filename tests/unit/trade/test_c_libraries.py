"""An object that wraps a C library is a provider like any other."""

import ctypes
import ctypes.util
import sys
from typing import Annotated, Any

import pytest

from trade import Container, Meta, service, where
from trade.errors import InvalidArgument

pytestmark = pytest.mark.realtime


class CMath:
    """The C library's own functions, through ctypes; other ways to C (cffi, extension modules) are used alike."""

    def __init__(self) -> None:
        self._library: Any = ctypes.CDLL(ctypes.util.find_library("m") or ctypes.util.find_library("c"))
        self._library.hypot.argtypes = [ctypes.c_double, ctypes.c_double]
        self._library.hypot.restype = ctypes.c_double

    @service(effect="read")
    def hypot(self, x: Annotated[float, Meta(ge=0)], y: float) -> float:
        """Length of a vector."""
        return self._library.hypot(x, y)


@pytest.mark.skipif(sys.platform == "win32", reason="the C runtime has no name of its own there")
def test_an_object_around_a_c_library_is_called_from_elsewhere(here: Container, there: Container) -> None:
    there.register(CMath(), "mathematics")
    hypot = here.find(where(group="mathematics"), wait_s=20)
    assert hypot(3.0, 4.0) == 5.0
    with pytest.raises(InvalidArgument):
        hypot(-3.0, 4.0)
