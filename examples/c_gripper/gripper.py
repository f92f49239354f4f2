"""A gripper whose vendor ships a C library, as services.

cc -shared -fPIC -O2 -o libgripper.so gripper.c
python gripper.py                                       # and elsewhere: trade call rosie.hand.move_to 0.02
"""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import trade
from trade import Meta, service
from trade.errors import ConfigurationError
from trade_drivers.clibrary import CLibrary

HEADER = """
    typedef struct gripper gripper_t;
    typedef struct { double width_m; double speed_m_s; int moving; } gripper_state_t;
    gripper_t *gripper_open(const char *port);
    void gripper_close(gripper_t *);
    int gripper_move(gripper_t *, double width_m, double speed_m_s);
    int gripper_stop(gripper_t *);
    int gripper_state(gripper_t *, gripper_state_t *state);
    int gripper_forces(gripper_t *, double *newtons, size_t count);
    int gripper_set_fingers(gripper_t *, const double *offsets_m, size_t count);
    uint32_t gripper_version(void);
    const char *gripper_text(int status);
"""

lib = CLibrary(Path(__file__).with_name("libgripper.so"), HEADER, text="gripper_text")

Width = Annotated[float, Meta(ge=0.0, le=0.085)]
Speed = Annotated[float, Meta(gt=0.0, le=0.15)]


@dataclass(frozen=True)
class State:
    """The members of ``gripper_state_t`` that callers get."""

    width_m: float
    speed_m_s: float
    moving: bool


class CGripper:
    """The library's functions as services; a body of ``...`` means that the library does all of it."""

    def __init__(self, port: str) -> None:
        self.device = lib.c.gripper_open(port.encode())
        if self.device == lib.ffi.NULL:
            raise ConfigurationError(where=port, problem="the gripper cannot be opened")

    def close(self) -> None:
        lib.c.gripper_close(self.device)

    @service(uses="hand", cancel="stop")
    @lib.function("gripper_move", handle="device")
    def move_to(self, width_m: Width, speed_m_s: Speed = 0.05) -> None:
        """Open or close to a width; returns when the gripper has reached it."""

    @service(effect="stop", uses="hand")
    @lib.function("gripper_stop", handle="device")
    def stop(self) -> None:
        """Hold where it is."""

    @service(effect="read")
    @lib.function("gripper_state", handle="device")
    def state(self) -> State:
        """Where it is."""
        ...

    @service(effect="read")
    @lib.function("gripper_forces", handle="device", out=2)
    def forces_n(self) -> list[float]:
        """Of its fingers, in newtons."""
        ...

    @service(uses="hand")
    @lib.function("gripper_set_fingers", handle="device")
    def set_fingers(self, offsets_m: list[float]) -> None:
        """How far each finger is bent, in metres."""

    @service(effect="read")
    @lib.function("gripper_version")
    def version(self) -> int:
        """Of its firmware."""
        ...


def main() -> None:
    gripper = CGripper(port=str(Path(__file__).with_name("gripper.log")))
    trade.register(gripper, "rosie.hand")
    print("rosie.hand is registered; Ctrl-C ends it", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        trade.deregister(gripper)  # what moves stops
        trade.close()
        gripper.close()


if __name__ == "__main__":
    main()
