"""The RTDE interface: clients select the fields that they read and set, then both sides send them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from ._arm import Arm
from ._program import PLAYING, Program
from ._protocol import MOST_PAYLOAD, Packet, PacketType, Recipe, Value, frames, names_in
from ._table import INPUTS, OUTPUTS, RobotMode

_INT: Final = "input_int_register_"
_DOUBLE: Final = "input_double_register_"
_SLIDER_BIT: Final = 1
Say = Callable[[Packet, str], None]


class RtdeSession:
    """The set-up of one client.

    Args:
        say: sends it a packet; the second argument names the packet, for faults.
    """

    def __init__(self, say: Say) -> None:
        self.say = say
        self.outputs: Recipe | None = None
        self.recipe_id = 0
        self.every = 1
        """Cycles between two packets of data."""
        self.started = False
        self.inputs: list[Recipe] = []


class Rtde:
    """Serves all RTDE clients of one controller.

    Args:
        program: reads what clients set.
        rate_hz: cycles a second: 500, or 125 on older controllers.
    """

    def __init__(self, program: Program, rate_hz: float) -> None:
        self._program = program
        self._arm = program.arm
        self._rate_hz = rate_hz
        self._sessions: list[RtdeSession] = []
        self._cycles = 0
        self.frozen: dict[str, Value] = {}
        """Frozen fields."""

    def joined(self, say: Say) -> RtdeSession:
        """A client has connected."""
        session = RtdeSession(say)
        self._sessions.append(session)
        return session

    def left(self, session: RtdeSession) -> None:
        """A client has disconnected; others can set its fields."""
        self._sessions.remove(session)

    def received(self, session: RtdeSession, held: bytearray) -> None:
        """Carry out the packets of a client.

        Raises:
            ValueError: the bytes are not RTDE.
        """
        for packet in frames(held):
            self._obey(session, packet)

    def cycle(self) -> None:
        """Send data to the clients that are due in this cycle."""
        self._cycles += 1
        due = [s for s in self._sessions if s.started and s.outputs is not None and self._cycles % s.every == 0]
        if not due:
            return
        values = measured(self._arm, self._program) | self.frozen
        for session in due:
            if session.outputs is not None:
                data = bytes([session.recipe_id]) + session.outputs.pack(values)
                session.say(Packet(PacketType.DATA, data), "data")

    def _obey(self, session: RtdeSession, packet: Packet) -> None:
        match packet.kind:
            case PacketType.PROTOCOL:
                answer = bytes([packet.payload == b"\x00\x02"])
            case PacketType.VERSION:
                answer = b"".join(number.to_bytes(4, "big") for number in self._arm.series.version)
            case PacketType.OUTPUTS:
                answer = self._want(session, packet.payload)
            case PacketType.INPUTS:
                answer = self._offer(session, packet.payload)
            case PacketType.START:
                session.started = session.outputs is not None
                answer = bytes([session.started])
            case PacketType.PAUSE:
                session.started = False
                answer = b"\x01"
            case PacketType.DATA:
                self._set(session, packet.payload)
                return
            case _:
                return
        if len(answer) > MOST_PAYLOAD:
            raise ValueError(f"the answer to a request of {len(packet.payload)} bytes has {len(answer)} bytes")
        session.say(Packet(packet.kind, answer), "rtde")

    def _want(self, session: RtdeSession, payload: bytes) -> bytes:
        wanted_hz = _frequency(payload[:8])
        names = names_in(payload[8:])
        lacks = self._arm.series.lacks
        types = ["NOT_FOUND" if name in lacks else OUTPUTS.get(name, "NOT_FOUND") for name in names]
        if "NOT_FOUND" in types or wanted_hz is None:
            return b"\x00" + ",".join(types).encode()
        session.outputs = Recipe(names, OUTPUTS)
        session.recipe_id += 1
        session.every = max(1, round(self._rate_hz / wanted_hz))
        return bytes([session.recipe_id]) + ",".join(types).encode()

    def _offer(self, session: RtdeSession, payload: bytes) -> bytes:
        names = names_in(payload)
        taken = {name for other in self._sessions if other is not session for r in other.inputs for name in r.names}
        types = ["IN_USE" if name in taken else INPUTS.get(name, "NOT_FOUND") for name in names]
        if {"IN_USE", "NOT_FOUND"} & set(types):
            return b"\x00" + ",".join(types).encode()
        session.inputs.append(Recipe(names, INPUTS))
        return bytes([len(session.inputs)]) + ",".join(types).encode()

    def _set(self, session: RtdeSession, payload: bytes) -> None:
        number = payload[0] if payload else 0
        if not 1 <= number <= len(session.inputs):
            raise ValueError(f"data for recipe {number}, of {len(session.inputs)}")
        values = session.inputs[number - 1].unpack(payload[1:])
        if values.get("speed_slider_mask") == _SLIDER_BIT:
            fraction = values["speed_slider_fraction"]
            self._arm.speed_fraction = fraction if isinstance(fraction, float) and 0 <= fraction <= 1 else 1.0
        ints = {number: int(value) for number, value in _registers(values, _INT)}
        self._program.written(ints, dict(_registers(values, _DOUBLE)))


def measured(arm: Arm, program: Program) -> dict[str, Value]:
    """The values of the controller in a cycle."""
    pose, still = arm.pose(), (0.0,) * 6
    values: dict[str, Value] = {name: _NOTHING[kind] for name, kind in OUTPUTS.items()}
    powered = arm.robot_mode >= RobotMode.POWER_ON
    values |= {
        "timestamp": arm.t,
        **dict.fromkeys(("target_q", "actual_q"), arm.q),
        **dict.fromkeys(("target_qd", "actual_qd"), arm.speeds),
        **dict.fromkeys(("target_TCP_pose", "actual_TCP_pose"), pose),
        "joint_temperatures": (30.0,) * 6,
        "actual_joint_voltage": (48.0,) * 6 if powered else still,
        "actual_main_voltage": 48.0,
        "actual_robot_voltage": 48.0 if powered else 0.0,
        "robot_mode": int(arm.robot_mode),
        "joint_mode": (253 if arm.ready else 239,) * 6,
        "safety_mode": int(arm.safety_mode),
        "speed_scaling": arm.speed_fraction if program.state == PLAYING else 0.0,
        "target_speed_fraction": arm.speed_fraction,
        "runtime_state": program.state,
        "robot_status_bits": int(powered) | (program.state == PLAYING) << 1 | arm.freedrive << 2,
        "safety_status_bits": arm.safety_mode.status_bits,
    }
    values |= {f"output_int_register_{n}": value for n, value in program.out_ints.items()}
    values |= {f"output_double_register_{n}": value for n, value in program.out_doubles.items()}
    return values


_NOTHING: Final[Mapping[str, Value]] = {
    **dict.fromkeys(("UINT32", "UINT64", "INT32"), 0),
    "DOUBLE": 0.0,
    "VECTOR3D": (0.0,) * 3,
    "VECTOR6D": (0.0,) * 6,
    "VECTOR6INT32": (0,) * 6,
}


def _frequency(data: bytes) -> float | None:
    wanted = Recipe(["timestamp"], OUTPUTS).unpack(data)["timestamp"] if len(data) == 8 else None
    return wanted if isinstance(wanted, float) and 1 <= wanted <= 1000 else None


def _registers(values: Mapping[str, Value], prefix: str) -> Iterator[tuple[int, float]]:
    for name, value in values.items():
        if name.startswith(prefix) and not isinstance(value, Sequence):
            yield int(name[len(prefix) :]), value
