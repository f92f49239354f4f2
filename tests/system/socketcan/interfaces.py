"""Interfaces of the system, as ``ip`` makes and changes them."""

import subprocess

__all__ = ["down", "ip", "up"]


def ip(*words: str) -> None:
    """Runs ``ip WORDS``; raises CalledProcessError."""
    subprocess.run(["ip", *words], capture_output=True, text=True, check=True, timeout=20)


def down(interface: str) -> None:
    ip("link", "set", interface, "down")


def up(interface: str) -> None:
    ip("link", "set", interface, "up")
