"""Connections of strangers, which send nothing."""

import socket


def is_closed(stranger: socket.socket) -> bool:
    """Whether the other end has closed it."""
    stranger.settimeout(0)
    try:
        return stranger.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
