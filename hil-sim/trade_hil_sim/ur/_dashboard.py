"""The dashboard server: one line in, one line out, about power, safety and programs.

Source: Universal Robots, "Dashboard Server e-Series"; clients parse the wording of the answers.
"""

from collections.abc import Callable
from typing import Final

from ._arm import Arm
from ._program import PAUSED, PLAYING, Program
from ._table import SafetyMode

GREETING: Final = "Connected: Universal Robots Dashboard Server"
_STATES: Final = {PLAYING: "PLAYING", PAUSED: "PAUSED"}
_NAME: Final = "wave.urp"
_WAIT: Final = "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"


class Dashboard:
    """Answers the lines of clients.

    Args:
        program: of the arm.
        remote: whether the controller is in remote control; if not, it only answers questions.
    """

    def __init__(self, program: Program, *, remote: bool = True) -> None:
        self._program = program
        self._arm: Arm = program.arm
        self.remote = remote
        self._loaded = _NAME
        arm = self._arm
        numbers = ".".join(str(number) for number in arm.series.version)
        self._queries: dict[str, Callable[[], str]] = {
            "robotmode": lambda: f"Robotmode: {arm.robot_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {arm.safety_mode.name}",
            "safetymode": lambda: f"Safetymode: {arm.safety_mode.name}",
            "programstate": lambda: f"{_STATES.get(program.state, 'STOPPED')} {self._loaded}",
            "running": lambda: f"Program running: {str(program.state == PLAYING).lower()}",
            "is in remote control": lambda: str(self.remote).lower(),
            "polyscopeversion": lambda: f"URSoftware {numbers} (Jan 01 2021)",
            "version": lambda: f"URSoftware {numbers} (Jan 01 2021)",
            "get serial number": lambda: "20210000001",
            "get robot model": lambda: arm.model.rstrip("e"),
            "get loaded program": lambda: f"Loaded program: {self._loaded}",
            "isprogramsaved": lambda: f"true {self._loaded}",
        }
        self._ordered: dict[str, Callable[[], str]] = {
            "stop": self._stop,
            "play": lambda: "Starting program" if program.play() else "Failed to execute: play",
            "pause": lambda: "Failed to execute: pause",
            "power on": lambda: "Powering on" if arm.power(True) else "",
            "power off": lambda: "Powering off" if arm.power(False) else "",
            "brake release": lambda: "Brake releasing" if arm.release_brakes() else "",
            "unlock protective stop": lambda: "Protective stop releasing" if arm.unlock() else _WAIT,
            "close safety popup": lambda: "closing safety popup",
            "close popup": lambda: "closing popup",
            "restart safety": self._restart,
        }

    def answer(self, line: str) -> str:
        """The answer to a line."""
        word = " ".join(line.split())
        low = word.lower()
        if low in self._queries and low not in self._arm.series.lacks:
            return self._queries[low]()
        if not (low in self._ordered or low.startswith(("load ", "popup "))):
            return f'could not understand: "{word}"'
        if not self.remote:
            return f'Command is not allowed due to safety reasons: "{low}". Switch to remote control'
        if low.startswith("load "):
            self._loaded = word[5:]
            return f"Loading program: {self._loaded}"
        return self._ordered[low]() if low in self._ordered else "showing popup"

    def _stop(self) -> str:
        self._program.stop()
        return "Stopped"

    def _restart(self) -> str:
        self._arm.power(False)
        self._arm.safety(SafetyMode.NORMAL)
        return "Restarting safety"


def lines_in(held: bytearray) -> list[str]:
    """Take the complete lines from the buffer."""
    whole, found, rest = bytes(held).rpartition(b"\n")
    held[:] = rest
    return [line.decode(errors="replace").strip() for line in whole.split(b"\n")] if found else []
