"""What a frame is on a bus of Damiao motors whose answers have the identifiers their vendor's tool sets."""

from typing import Final

from trade_hil_sim.can import Frame

from . import _table as table

__all__ = ["damiao_label"]

ORDERS: Final = {
    table.ENABLE: "enable",
    table.DISABLE: "disable",
    table.ZERO: "set_zero",
    table.CLEAR: "clear_error",
}
QUESTIONS: Final = {
    table.READ: "read_register",
    table.WRITE: "write_register",
    table.STORE: "store",
    table.REFRESH: "refresh",
}
TARGETS: Final = {
    table.POSITION_VELOCITY: "pos_vel",
    table.VELOCITY: "vel",
    table.FORCE_POSITION: "force_pos",
}


def damiao_label(frame: Frame) -> tuple[str, int | None]:
    """Name of a frame, and the motor it comes from or goes to."""
    data = frame.data
    if frame.extended or frame.remote:
        return "", None
    if frame.can_id == table.EVERYBODY:
        return (QUESTIONS.get(data[2], ""), data[0]) if len(data) > 3 else ("", None)
    base, motor = frame.can_id & 0x700, frame.can_id & 0xFF
    if base in TARGETS:
        return TARGETS[base], motor
    if base:
        return "", None
    if motor < table.MASTER:
        return (ORDERS.get(data[7], "mit") if data[:7] == b"\xff" * 7 and len(data) == 8 else "mit"), motor
    about = data[:2] == bytes((motor - table.MASTER, 0)) and data[2:3] in {bytes((table.READ,)), bytes((table.WRITE,))}
    return ("register" if about else "feedback"), motor - table.MASTER
