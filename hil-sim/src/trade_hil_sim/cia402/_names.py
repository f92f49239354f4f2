"""What a frame is on a CANopen bus, by its id: the predefined connection set (CiA 301, 7.3.5)."""

from typing import Final

from trade_hil_sim.can import Frame

__all__ = ["canopen_label"]

NODES: Final = 0x80
FUNCTIONS: Final = {
    0x180: "tpdo1",
    0x200: "rpdo1",
    0x280: "tpdo2",
    0x300: "rpdo2",
    0x380: "tpdo3",
    0x400: "rpdo3",
    0x480: "tpdo4",
    0x500: "rpdo4",
    0x580: "sdo_reply",
    0x600: "sdo_request",
    0x700: "heartbeat",
}


def canopen_label(frame: Frame) -> tuple[str, int | None]:
    """Name of a frame, and the node it comes from or goes to."""
    if frame.extended:
        return "", None
    node, function = frame.can_id & NODES - 1, frame.can_id & ~(NODES - 1)
    match function:
        case 0x000 if node == 0:
            return "nmt", frame.data[1] or None if len(frame.data) > 1 else None
        case 0x080:
            return ("emcy", node) if node else ("sync", None)
        case _ if node and function in FUNCTIONS:
            boots = function == 0x700 and frame.data == b"\0"
            return "boot_up" if boots else FUNCTIONS[function], node
        case _:
            return "", None
