"""The object dictionary of a servo drive, by hand: CiA 301 (communication), CiA 402-2 (drive profile).

Positions are in counts; speeds in counts/s and accelerations in counts/s^2, unless the drive has objects that say
otherwise (`unit_objects`). Torque and current are in thousandths of rated.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

SIZES: Final = {"u8": 1, "i8": 1, "u16": 2, "i16": 2, "u32": 4, "i32": 4, "text": 0}
I32: Final = 2**31
PDOS: Final = 4
"""How many receive and transmit PDOs there are."""
ENTRIES: Final = 8
SUPPORTED_MODES: Final = frozenset({1, 3, 4, 6, 8, 9, 10})
"""Profile position, velocity, torque; homing; cyclic synchronous position, velocity, torque."""
MODE_BITS: Final = sum(1 << (mode - 1) for mode in SUPPORTED_MODES)


@dataclass(frozen=True, slots=True)
class Object:
    """One entry of the object dictionary."""

    index: int
    sub: int
    name: str
    kind: str
    """``u8`` to ``i32``, or ``text``."""
    access: str
    """``ro``, ``rw`` or ``wo``."""
    default: int | bytes = 0
    mapped: str = ""
    """Which PDOs may carry it: ``r``, ``t`` or both."""
    low: int | None = None
    high: int | None = None
    measured: bool = False
    """Whether it changes continuously, so that a change of it is no event."""
    optional: bool = False
    """Whether a drive lacks it unless it is added."""

    @property
    def size(self) -> int:
        """Bytes; 0 for text."""
        return SIZES[self.kind]

    @property
    def signed(self) -> bool:
        """Whether it may be negative."""
        return self.kind.startswith("i")

    def encode(self, value: int) -> bytes:
        """Its bytes on the wire."""
        return (value & ((1 << 8 * self.size) - 1)).to_bytes(self.size, "little")

    def decode(self, data: bytes) -> int:
        """The value of bytes on the wire."""
        return int.from_bytes(data, "little", signed=self.signed)


def _array(
    index: int,
    name: str,
    names: Iterable[str],
    kind: str,
    defaults: Iterable[int],
    access: str = "rw",
    low: int | None = None,
    high: int | None = None,
) -> list[Object]:
    values = list(zip(names, defaults, strict=True))
    head = Object(index, 0, f"{name}_count", "u8", "ro", len(values))
    return [head, *(Object(index, k, n, kind, access, v, low=low, high=high) for k, (n, v) in enumerate(values, 1))]


COMMUNICATION: Final = (
    Object(0x1000, 0, "device_type", "u32", "ro", 0x0002_0192),
    Object(0x1001, 0, "error_register", "u8", "ro", mapped="t"),
    Object(0x1003, 0, "error_history_count", "u8", "rw", low=0, high=0),
    *(Object(0x1003, k, f"error_history_{k}", "u32", "ro") for k in range(1, 9)),
    Object(0x1005, 0, "sync_cob_id", "u32", "rw", 0x80),
    Object(0x1008, 0, "device_name", "text", "ro", b"Simulated CiA 402 servo drive"),
    Object(0x1009, 0, "hardware_version", "text", "ro", b"sim"),
    Object(0x100A, 0, "software_version", "text", "ro", b"0.1.0"),
    *_array(0x1010, "store", ["store_all"], "u32", [0]),
    Object(0x1014, 0, "emcy_cob_id", "u32", "rw", 0x80),
    *_array(0x1016, "consumer_heartbeat", ["consumer_heartbeat_1", "consumer_heartbeat_2"], "u32", [0, 0]),
    Object(0x1017, 0, "producer_heartbeat_ms", "u16", "rw"),
    *_array(
        0x1018, "identity", ["vendor_id", "product_code", "revision", "serial_number"], "u32", [0x2A7, 402, 1, 0], "ro"
    ),
    *_array(0x1029, "error_behaviour", ["communication_error_behaviour"], "u8", [0], low=0, high=2),
)

DRIVE: Final = (
    Object(0x6007, 0, "abort_connection_option", "i16", "rw", 1, low=0, high=3),
    Object(0x603F, 0, "error_code", "u16", "ro", mapped="t"),
    Object(0x6040, 0, "controlword", "u16", "rw", mapped="rt"),
    Object(0x6041, 0, "statusword", "u16", "ro", mapped="t"),
    Object(0x605A, 0, "quick_stop_option", "i16", "rw", 2, low=0, high=7),
    Object(0x605B, 0, "shutdown_option", "i16", "rw", 0, low=0, high=1),
    Object(0x605C, 0, "disable_operation_option", "i16", "rw", 1, low=0, high=1),
    Object(0x605D, 0, "halt_option", "i16", "rw", 1, low=1, high=3),
    Object(0x605E, 0, "fault_reaction_option", "i16", "rw", 2, low=0, high=3),
    Object(0x6060, 0, "mode", "i8", "rw", mapped="rt"),
    Object(0x6061, 0, "mode_display", "i8", "ro", mapped="t"),
    Object(0x6062, 0, "position_demand", "i32", "ro", mapped="t", measured=True),
    Object(0x6064, 0, "position_actual", "i32", "ro", mapped="t", measured=True),
    Object(0x6065, 0, "following_error_window", "u32", "rw", 2000),
    Object(0x6066, 0, "following_error_timeout_ms", "u16", "rw", 50),
    Object(0x6067, 0, "position_window", "u32", "rw", 10),
    Object(0x6068, 0, "position_window_ms", "u16", "rw", 0),
    Object(0x606B, 0, "velocity_demand", "i32", "ro", mapped="t", measured=True),
    Object(0x606C, 0, "velocity_actual", "i32", "ro", mapped="t", measured=True),
    Object(0x6071, 0, "target_torque", "i16", "rw", mapped="rt", low=-1000, high=1000),
    Object(0x6072, 0, "max_torque", "u16", "rw", 1000, mapped="rt"),
    Object(0x6075, 0, "rated_current_ma", "u32", "ro", 5000),
    Object(0x6076, 0, "rated_torque_mnm", "u32", "ro", 1000),
    Object(0x6077, 0, "torque_actual", "i16", "ro", mapped="t", measured=True),
    Object(0x6078, 0, "current_actual", "i16", "ro", mapped="t", measured=True),
    Object(0x6079, 0, "dc_link_mv", "u32", "ro", 48_000, mapped="t", measured=True),
    Object(0x607A, 0, "target_position", "i32", "rw", mapped="rt"),
    Object(0x607C, 0, "home_offset", "i32", "rw"),
    *_array(0x607D, "position_limit", ["position_limit_min", "position_limit_max"], "i32", [-I32, I32 - 1]),
    Object(0x607E, 0, "polarity", "u8", "rw"),
    Object(0x607F, 0, "max_profile_velocity", "u32", "rw", 2_000_000, mapped="rt"),
    Object(0x6081, 0, "profile_velocity", "u32", "rw", 20_000, mapped="rt"),
    Object(0x6083, 0, "profile_acceleration", "u32", "rw", 200_000, mapped="rt", low=1),
    Object(0x6084, 0, "profile_deceleration", "u32", "rw", 200_000, mapped="rt", low=1),
    Object(0x6085, 0, "quick_stop_deceleration", "u32", "rw", 2_000_000, mapped="rt", low=1),
    Object(0x6098, 0, "homing_method", "i8", "rw", 35),
    *_array(0x6099, "homing_speed", ["homing_switch_speed", "homing_zero_speed"], "u32", [10_000, 1000], low=1),
    Object(0x609A, 0, "homing_acceleration", "u32", "rw", 100_000, low=1),
    Object(0x60B0, 0, "position_offset", "i32", "rw", mapped="rt"),
    Object(0x60B1, 0, "velocity_offset", "i32", "rw", mapped="rt"),
    Object(0x60B2, 0, "torque_offset", "i16", "rw", mapped="rt"),
    Object(0x60C2, 0, "interpolation_period_count", "u8", "ro", 2),
    Object(0x60C2, 1, "interpolation_period", "u8", "rw", 10, low=1),
    Object(0x60C2, 2, "interpolation_exponent", "i8", "rw", -3, low=-6, high=0),
    Object(0x60C5, 0, "max_acceleration", "u32", "rw", 20_000_000, low=1),
    Object(0x60F4, 0, "following_error", "i32", "ro", mapped="t", measured=True),
    Object(0x60FD, 0, "digital_inputs", "u32", "ro", mapped="t"),
    Object(0x60FF, 0, "target_velocity", "i32", "rw", mapped="rt"),
    Object(0x6502, 0, "supported_modes", "u32", "ro", MODE_BITS),
)

OPTIONAL: Final = (
    *(
        Object(index, sub, f"{name}_{sub or 'count'}", "u32" if sub else "u8", "ro", 1 if sub else 2, optional=True)
        for index, name in ((0x608F, "encoder"), (0x6091, "gear_ratio"), (0x6092, "feed"))
        for sub in range(3)
    ),
    *(
        Object(index, 0, f"si_{name}", "u32", "ro", optional=True)
        for index, name in ((0x60A8, "position"), (0x60A9, "velocity"), (0x60AA, "acceleration"))
    ),
)
"""Scale and units: the factor group, and what positions, speeds and accelerations count in."""

DUMMIES: Final = tuple(
    Object(index, 0, f"dummy_{kind}", kind, "rw", mapped="r")
    for index, kind in ((2, "i8"), (3, "i16"), (4, "i32"), (5, "u8"), (6, "u16"), (7, "u32"))
)
"""Data types that a receive PDO may map in place of objects, to skip bytes (CiA 301, 7.4.7)."""

_RECEIVED: Final = ((0x6040,), (0x6040, 0x6060), (0x6040, 0x607A), (0x6040, 0x60FF))
_SENT: Final = ((0x6041,), (0x6041, 0x6061), (0x6041, 0x6064), (0x6041, 0x606C))
_SIZE_OF: Final = {entry.index: entry.size for entry in DRIVE if entry.sub == 0}


def pdo_objects(node: int) -> list[Object]:
    """The objects that say how PDOs are sent and what they carry; of each kind only the first is valid at power-up."""
    made = list[Object]()
    for k in range(PDOS):
        off = 0 if k == 0 else 1 << 31
        made += _pdo(0x1400 + k, f"rpdo{k + 1}", off | (0x200 + 0x100 * k + node), _RECEIVED[k])
        made += _pdo(0x1800 + k, f"tpdo{k + 1}", off | 0x4000_0000 | (0x180 + 0x100 * k + node), _SENT[k])
    return made


def _pdo(index: int, name: str, cob_id: int, carries: tuple[int, ...]) -> list[Object]:
    entries = [i << 16 | 8 * _SIZE_OF[i] for i in carries] + [0] * (ENTRIES - len(carries))
    return [
        Object(index, 0, f"{name}_settings", "u8", "ro", 5),
        Object(index, 1, f"{name}_cob_id", "u32", "rw", cob_id),
        Object(index, 2, f"{name}_type", "u8", "rw", 255),
        Object(index, 3, f"{name}_inhibit_100us", "u16", "rw"),
        Object(index, 5, f"{name}_event_ms", "u16", "rw"),
        Object(index + 0x200, 0, f"{name}_count", "u8", "rw", len(carries), high=ENTRIES),
        *(Object(index + 0x200, k, f"{name}_entry_{k}", "u32", "rw", entry) for k, entry in enumerate(entries, 1)),
    ]


OBJECTS: Final = (*COMMUNICATION, *DRIVE, *OPTIONAL)
