"""Sections of ``trade --help``. The module of a command names its section in ``SECTION``."""

from typing import Final

ROBOTS: Final = "Robots, containers and networks"
OPERATION: Final = "Operation"
HARDWARE: Final = "Hardware setup"
SERVICES: Final = "Services"
MOTION: Final = "Locks and stops"
WATCHING: Final = "Watching and rules"
RECORDINGS: Final = "Recordings and live views"
RIGHTS: Final = "Identities and rights"
OTHERS: Final = "Other packages"

ORDER: Final = (ROBOTS, OPERATION, HARDWARE, SERVICES, MOTION, WATCHING, RECORDINGS, RIGHTS, OTHERS)
