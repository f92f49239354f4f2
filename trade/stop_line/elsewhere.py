"""Other systems of this user on this host: for a command that finds nothing in its own."""

import contextlib
from typing import Final

from trade._paths import runtime_folders
from trade._settings import Settings
from trade.errors import ConfigurationError
from trade.protocol.messages import Malformed
from trade.stop_line.messages import VERSION, StopRequest, encoded, read_answer
from trade.stop_line.places import host_places
from trade.transport.host_socket import process_of

_MOST: Final = 16
_ANSWER_S: Final = 0.3


def elsewhere(settings: Settings) -> dict[str, list[str]]:
    """The containers with something to stop in this user's other systems on this host, by system.

    Each is described as ``rosie (pid 12)``, or ``rosie`` if its process is in another namespace. Takes 0.3 s at most
    for each container that does not answer.
    """
    found: dict[str, list[str]] = {}
    with contextlib.suppress(OSError, ConfigurationError):
        systems = {one.name for folder in runtime_folders() for one in folder.iterdir() if one.is_dir()}
        known = [(system, place) for system in sorted(systems - {settings.system}) for place in host_places(system)]
        for system, place in known[:_MOST]:
            with contextlib.suppress(OSError, Malformed, ValueError), place.connect(_ANSWER_S) as sock:
                sock.settimeout(_ANSWER_S)
                sock.sendall(encoded(StopRequest(v=VERSION, ask="open")))
                with sock.makefile("rb") as answers:
                    name = read_answer(answers.readline(1 << 20)).who.rpartition("/")[2]
                process = process_of(sock)
                found.setdefault(system, []).append(f"{name} (pid {process})" if process else name)
    return found
