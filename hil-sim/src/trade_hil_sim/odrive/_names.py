"""What a frame is on a bus of ODrives, by its id and whether it has data."""

from trade_hil_sim.can import Frame

from ._table import ANSWERS, Command

__all__ = ["odrive_label"]

_KNOWN = {int(command): command for command in Command}


def odrive_label(frame: Frame) -> tuple[str, int | None]:
    """Name of a frame, and the node it comes from or goes to; a question is named after its answer: ``ask_get_iq``."""
    if frame.extended:
        return "", None
    command, node = _KNOWN.get(frame.can_id & 0x1F), frame.can_id >> 5
    if command is None:
        return "", node
    asks = command in ANSWERS and (frame.remote or not frame.data)
    return f"ask_{command.name.lower()}" if asks else command.name.lower(), node
