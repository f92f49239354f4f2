"""Where something listens: whether that is this host alone, and how it is written."""

from ipaddress import ip_address

__all__ = ["in_url", "is_loopback"]


def is_loopback(host: str) -> bool:
    """Whether nobody beyond this host can reach it; a name other than ``localhost`` counts as reachable."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def in_url(host: str) -> str:
    """A host as it stands in a URL: IPv6 addresses have brackets there."""
    return f"[{host}]" if ":" in host else host
