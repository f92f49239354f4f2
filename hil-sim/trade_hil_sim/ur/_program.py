"""The program of a controller: the control script of ur-rtde, which a host controls through registers, or its own.

The numbers in the registers, and when the script reads and writes them, were observed on the wire between the library
and a controller; the script itself is the library's.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec

from trade_hil_sim.log._byte_log import LogEntry

from ._arm import Arm
from ._motions import PathMotion
from ._table import Command

STOPPED: Final = 1
PLAYING: Final = 2
PAUSED: Final = 4
_START_S: Final = 0.02
_READY: Final = 1
_DONE: Final = 2
_RUNNING_BIT: Final = 1 << 15
_EVERY_CYCLE: Final = frozenset({Command.SERVO_J, Command.SERVO_L, Command.SPEED_J, Command.STEP_TIME})
"""Commands that are carried out again in every cycle, and not answered."""
_ENDING: Final = frozenset({Command.MOVE_J, Command.MOVE_J_IK, Command.MOVE_L, Command.MOVE_L_FK})
"""Moves with an end: asynchronous, or the script reads no commands until they have ended."""
_MOVES: Final = frozenset(
    {
        *(Command.MOVE_J, Command.MOVE_J_IK, Command.MOVE_L, Command.MOVE_L_FK, Command.SPEED_J),
        *(Command.SERVO_J, Command.SERVO_L, Command.TEACH_ON, Command.FREEDRIVE_ON),
    }
)
_WAVE_RAD_S: Final = 0.2


class Program:
    """The running program on the controller of one arm.

    Args:
        arm: what it moves.
        emit: called with each log entry.
        step_s: the controller's cycle time.
    """

    def __init__(self, arm: Arm, emit: Callable[[LogEntry], None], step_s: float) -> None:
        self.arm = arm
        self.state = STOPPED
        """``runtime_state``."""
        self.kind = ""
        """``control``: the library's script; ``played``: one of the controller's own."""
        self.ints: dict[int, int] = {}
        self.doubles: dict[int, float] = {}
        self.out_ints = dict.fromkeys(range(48), 0)
        self.out_doubles = dict.fromkeys(range(48), 0.0)
        self.watchdog_hz = 0.0
        self._emit, self._step_s = emit, step_s
        self._starts_at: float | None = None
        self._fed_at = 0.0
        self._busy = False
        """A command that is answered when its motion has ended is under way."""
        self._shown = Command.NOTHING
        self._async: PathMotion | None = None
        self._operation = self._writes = 0
        arm.stopped, arm.paused = self.stop, self.pause

    # --- from clients

    def upload(self, text: str) -> None:
        """Run a program from the script port, in place of the present one."""
        control = "def rtde_control()" in text
        self.stop()
        self._log("upload", detail="control" if control else text[:200], moves=not control)
        if control and self.arm.ready:
            self._starts_at = self.arm.t + _START_S

    def play(self) -> bool:
        """Run a program of the controller's own: it turns the last joint slowly, without end."""
        if not self.arm.ready:
            return False
        self.stop()
        self.state, self.kind = PLAYING, "played"
        return self.arm.turn((0.0,) * 5 + (_WAVE_RAD_S,), 1.0, 0.0)

    def stop(self) -> None:
        """End it; the joints that it moves brake."""
        self._starts_at = None
        if self.state != STOPPED:
            self.state, self.kind = STOPPED, ""
            self.watchdog_hz = 0.0
            self.arm.note("program_stopped")
            self.arm.halt()
        self._busy, self._async, self._shown = False, None, Command.NOTHING

    def pause(self, on: bool) -> None:
        """Pause for a safeguard stop: the script reads nothing and its watchdog does not count until it is over.

        Whether the watchdog of a real one counts meanwhile is unknown: this is the case that is worse for a driver.
        """
        if self.state == (PLAYING if on else PAUSED):
            self.state = PAUSED if on else PLAYING
            self._fed_at = self.arm.t
            self.arm.note("program_paused" if on else "program_resumed")

    def written(self, ints: Mapping[int, int], doubles: Mapping[int, float]) -> None:
        """Take the registers that a client has set."""
        self.ints.update(ints)
        self.doubles.update(doubles)
        if 0 not in ints:
            return
        self._fed_at = self.arm.t
        number = ints[0]
        self._log_command(number)
        if number == Command.END and self.kind == "control" and self.state == PLAYING:
            self.stop()

    # --- time

    def cycle(self) -> None:
        """Run one step of the script: read the registers, carry out the command, answer."""
        if self._starts_at is not None and self.arm.t >= self._starts_at:
            self._start()
        if self.kind != "control" or self.state != PLAYING:
            return
        if self.watchdog_hz and self.arm.t - self._fed_at > 1 / self.watchdog_hz:
            self.arm.note("watchdog_expired")
            self.stop()
            return
        self._follow_async()
        number = self.ints.get(0, 0)
        if number == Command.NOTHING:
            self._busy = False
            self.out_ints[0] = _READY
        elif number in _EVERY_CYCLE:
            self._obey(number)
            self.out_ints[0] = _READY
        elif self._busy:
            if self.arm.motion.done:
                self._busy, self.out_ints[0] = False, _DONE
        elif self.out_ints[0] != _DONE:
            self._busy = self._obey(number) and not self.arm.motion.done
            self.out_ints[0] = _READY if self._busy else _DONE

    def _start(self) -> None:
        self._starts_at = None
        if not self.arm.ready:
            return
        self.state, self.kind = PLAYING, "control"
        self.out_ints.update(dict.fromkeys(range(24), 0))
        self.out_doubles.update(dict.fromkeys(range(24), 0.0))
        self._fed_at = self.arm.t
        self.arm.note("program_started")

    def _obey(self, number: int) -> bool:
        """Carry the command out; True if its answer waits for the end of a motion."""
        d = [self.doubles.get(k, 0.0) for k in range(18)]
        arm = self.arm
        match number:
            case Command.MOVE_J | Command.MOVE_J_IK | Command.MOVE_L | Command.MOVE_L_FK:
                return self._move(number, d)
            case Command.SERVO_J:
                arm.servo(d[:6])
            case Command.SERVO_L:
                if (found := arm.joints_for(d[:6])) is not None:
                    arm.servo(found)
                else:
                    arm.protective_stop("the target is out of reach")
            case Command.SPEED_J:
                arm.turn(d[:6], d[6], d[7])
            case Command.STOP_J | Command.STOP_L | Command.SERVO_STOP | Command.SPEED_STOP:
                self._end_async()
                arm.halt(d[0] if number == Command.STOP_J else max(2.0, d[0]))
                return not self.ints.get(1, 0) or number in {Command.SERVO_STOP, Command.SPEED_STOP}
            case _:
                self._configure(number, d)
        return False

    def _configure(self, number: int, d: Sequence[float]) -> None:
        arm = self.arm
        match number:
            case Command.TEACH_ON | Command.FREEDRIVE_ON:
                arm.free(True)
            case Command.TEACH_OFF | Command.FREEDRIVE_OFF:
                arm.free(False)
            case Command.FREEDRIVE_STATUS:
                self.out_ints[1] = int(arm.freedrive)
            case Command.STEP_TIME:
                self.out_doubles[0] = self._step_s
            case Command.TRIGGER_PROTECTIVE_STOP:
                arm.protective_stop("triggered")
            case Command.WATCHDOG:
                self.watchdog_hz = d[0]
                arm.note("watchdog_armed", detail=f"{d[0]:g} Hz")
            case Command.STEADY:
                self.out_ints[1] = int(not arm.moving)
            case _:
                self._work_out(number, d)

    def _work_out(self, number: int, d: Sequence[float]) -> None:
        """Answer a question of geometry; asking for the angles of an unreachable pose ends the script."""
        near = d[6:12] if number in {Command.INVERSE_KINEMATICS_NEAR, Command.REACHES_NEAR} else None
        match number:
            case Command.FORWARD_KINEMATICS | Command.FORWARD_KINEMATICS_OF:
                pose = self.arm.pose(None if number == Command.FORWARD_KINEMATICS else d[:6])
                self.out_doubles.update(enumerate(pose))
            case Command.INVERSE_KINEMATICS | Command.INVERSE_KINEMATICS_NEAR:
                if (found := self.arm.joints_for(d[:6], near)) is None:
                    self.stop()
                else:
                    self.out_doubles.update(enumerate(found))
            case Command.REACHES | Command.REACHES_NEAR:
                self.out_ints[1] = int(self.arm.joints_for(d[:6], near) is not None)
            case _:
                self.out_doubles.update(dict.fromkeys(range(6), 0.0))  # not simulated: answered without effect

    def _move(self, number: int, d: Sequence[float]) -> bool:
        arm, goal = self.arm, d[:6]
        self._end_async()
        if number in {Command.MOVE_J, Command.MOVE_J_IK}:
            joints = goal if number == Command.MOVE_J else arm.joints_for(goal)
            if joints is None:
                arm.protective_stop("the goal is out of reach")
                return False
            begun = arm.move_joints(joints, d[6], d[7])
        else:
            begun = arm.move_line(goal if number == Command.MOVE_L else arm.pose(goal), d[6], d[7])
        if begun and self.ints.get(1, 0) and isinstance(arm.motion, PathMotion):
            self._async = arm.motion
            self._operation = (self._operation + 1) % 128
            self._tell_async(running=True)
            return False
        return begun

    def _follow_async(self) -> None:
        if self._async is not None and self.arm.motion is not self._async:
            self._end_async()

    def _end_async(self) -> None:
        if self._async is not None:
            self._async = None
            self._tell_async(running=False)

    def _tell_async(self, *, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        bits = _RUNNING_BIT if running else 0
        self.out_ints[2] = bits | self._writes << 16 | self._operation << 24

    # --- the log

    def _log_command(self, number: int) -> None:
        """Log every set-point of a stream, but a value that stays in the register only once."""
        again = number == self._shown and number not in _EVERY_CYCLE
        self._shown = Command(number) if number in set(Command) else Command.NOTHING
        if again or number == Command.NOTHING:
            return
        name = Command(number).name.lower() if number in set(Command) else f"command_{number}"
        values = msgspec.json.encode([round(self.doubles.get(k, 0.0), 6) for k in range(11)]).decode()
        waits = number in _ENDING and not self.ints.get(1, 0)
        self._log(name, detail=f"{values} until it ends" if waits else values, moves=number in _MOVES)

    def _log(self, name: str, *, detail: str, moves: bool) -> None:
        t = time.monotonic()  # the time of arrival: the arm's own time may lag
        self._emit(LogEntry(t, "", "instruction", name, joint=self.arm.name, detail=detail, moves=moves))
