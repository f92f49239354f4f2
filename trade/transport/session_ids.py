"""Ids of zenoh sessions. Of two that discover each other, the one with the greater id dials; it decides who that is."""

import secrets
import time
from typing import Final

_DIGITS: Final = 32
_ORDER: Final = 6
"""The bytes at the end of an id by which two are compared: a bit, and so many of the time in microseconds."""
_TIME_BITS: Final = 8 * _ORDER - 1
_NS_PER_US: Final = 1_000


def new_session_id(began_ns: int | None = None, *, dials: bool = False) -> str:
    """An id that zenoh keeps as it is written: its first digit is not zero.

    zenoh compares the last byte first. A session that listens on this host only can dial others but cannot be dialled
    from elsewhere: its id is the greater. Otherwise that of the session that began later is, because it dials the
    earlier ones of its host anyway (see `HostFolder`). If each dialled the other, both links would end, and zenoh 1.10
    may take the next one for ended, too, although it stays open.

    Args:
        began_ns: when the session's container began, in nanoseconds of the host's monotonic clock; None: now.
        dials: whether it cannot be dialled from elsewhere.
    """
    began = (time.monotonic_ns() if began_ns is None else began_ns) // _NS_PER_US % 2**_TIME_BITS
    order = (began + (dials << _TIME_BITS)).to_bytes(_ORDER, "little")
    digits = secrets.token_hex(_DIGITS // 2 - _ORDER)
    return f"{secrets.choice('123456789abcdef')}{digits[1:]}{order.hex()}"


def dials_first(own: str, there: str) -> bool:
    """Whether, of two sessions that discover each other, the first one dials."""
    mine, other = (bytes.fromhex(session.zfill(_DIGITS))[::-1] for session in (own, there))
    return mine > other
