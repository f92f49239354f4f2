"""How the corpus was made: real messages of every kind. Run as a program it writes those that are missing.

What fuzzing has found lies beside them as ``found-...`` and is not made here.
"""

import io
import json
import sqlite3
import struct
import tarfile
import tempfile
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import msgspec

from tests.endurance.fuzz._buses import EXAMPLES
from tests.endurance.fuzz._clients import _BODIES as BODIES
from tests.endurance.fuzz._core import _SIGNATURES as SIGNATURES
from tests.endurance.fuzz._ros import _KINDS as KINDS
from tests.endurance.fuzz._ros import _TYPES as TYPES
from tests.endurance.fuzz.targets import TARGETS
from trade import where
from trade._audit.hash_chain import AuditRow
from trade._audit.store import AuditStore
from trade.errors import LimitExceeded, LockedByOther
from trade.protocol.messages import EMPTY, PROTOCOL, Estop, encode_message
from trade.protocol.remote_errors import pack_error
from trade.protocol.samples import StreamSample
from trade.transport.scouting import hello
from trade_drivers.vendors.dynamixel._wire import crc16 as dynamixel_crc
from trade_drivers.vendors.feetech._wire import packet as feetech_packet
from trade_gateway.cli.operation._archive import _MANIFEST as MANIFEST
from trade_gateway.cli.operation._archive import ArchivedFile, Manifest
from trade_gateway.mcp._tools import TOOLS
from trade_gateway.ros.ros2._node import Attachment
from trade_hil_sim.dynamixel import encode as dynamixel_packet
from trade_hil_sim.robotiq._protocol import frame as modbus_frame

VECTORS: Final = Path(__file__).parents[3] / "docs" / "wire-vectors.json"
PACKAGE: Final = Path(__file__).parents[3] / "gateway/trade_gateway/language/lexicon.toml"
_OF_KIND: Final = {
    "Call": "wire-call",
    "Reply": "wire-reply",
    "ProviderInfo": "wire-provider",
    "Tally": "wire-tally",
    "StreamSample": "wire-sample",
    "EstopOrder": "wire-estop-order",
    "EstopConfirmed": "wire-estop-confirmed",
    "ErrorInfo": "wire-error",
}
_TOML: Final = {
    "policy-file": ["policy.toml"],
    "rules-file": ["rules.toml", "care.toml"],
    "robot-file": ["head.toml", "hand.toml", "legs.toml", "arm.toml", "eye.toml"],
    "ros-file": ["ros.toml"],
    "named-files": ["system.toml"],
}
_GATEWAY: Final = """
system = "lab"
credentials = "lab:secret"
audit = "record"

[container.attic]
providers = [{ class = "lamp:Lamp", groups = ["home.hall"], args = { level = 0.5 } }]
allow = ["lamp:Lamp"]
"""
_SYSTEM: Final = """
[system]
name = "home"

[container.attic]
providers = []
allow = ["lamp:Lamp"]

[container.lamps]
providers = [{ class = "lamp:Lamp", groups = ["home.hall"], args = { level = 0.5 } }]
after = ["attic"]
"""
_TOKENS: Final = f'[tokens]\n{"5" * 64} = "anna"\n'


def _wire() -> Iterator[tuple[str, bytes]]:
    for vector in json.loads(VECTORS.read_text(encoding="utf-8"))["messages"]:
        if vector["kind"] in _OF_KIND:
            yield _OF_KIND[vector["kind"]], bytes.fromhex(vector["hex"])
    yield "wire-sample", encode_message(StreamSample(PROTOCOL, 1, 1.5, 2, False, EMPTY))
    reported = [["e1", "anna/desk/e1", "smoke", 1.5, {"zone": 2}], ["e2", "bob/page/e2"]]
    yield "wire-open-estops", encode_message({"v": PROTOCOL + 1, "services": None, "estops": reported})
    later = [PROTOCOL + 1, "e1", ["e1", "anna/desk/e1", {"text": "smoke"}, None, 7], "more"]
    yield "wire-estop-order", encode_message(later)
    for error in (
        LimitExceeded(what="a", value=2.0, lower=0.0, upper=1.0, unit="rad"),
        KeyError("x"),
        OSError(2, "no"),
    ):
        yield "wire-error", encode_message(pack_error(error))
    yield "wire-error", encode_message(pack_error(LockedByOther(resources=("a",), owner="b/c", purpose="d", since=1.0)))
    arguments: dict[str, list[Any]] = {
        "turn": [[0.5], {"angle_rad": 0.5, "speed": 2.0}],
        "put": [[{"x": 1.0, "y": 0.5}, {"a": [1, "b"]}, [b"c"]], {"place": {"x": 1.0}, "names": {}}],
        "match": [{"which": where(name="x", group="a.b")}, [where(uses="c"), None, {"a": [1, 2.5, None]}]],
        "sign": [["secret", 6], {"token": "secret"}],
    }
    for number, (name, _) in enumerate(SIGNATURES):
        for one in arguments[name]:
            yield "wire-arguments", bytes([number]) + encode_message(one)
    for key in ("registry/rosie.neck.pan/anna/kitchen/e1/pan", "registry/_/a/b/c/d"):
        yield "wire-key", key.encode()
    for constraint in (
        where(name="mo*", group="rosie.hand") & ~where.local,
        where(args=[float], returns=bool) | where(achieves="open(?x)", meta={"a": 1}),
        where(uses="hand", kind="H?nd", host="h", container="[a-c]") & where.healthy,
    ):
        yield "constraint", encode_message(constraint)
    yield "predicates", b"open(?x), at(?x, ?y)\nopen(gripper)\nat(gripper, 1)"
    yield "predicates", b"on(cup, table)"
    for endpoint in ("tcp/127.0.0.1:7450", "tls/[::1]:7450?a=b", "tls/robot.example:1#iface=eth0"):
        yield "endpoint", endpoint.encode()
    yield "hello", hello("de88bef20f15d9afd64d6f625e211ef4", ["tcp/10.9.0.5:7450", "tls/[fd00::2]:7450"])
    yield "inherited-lock", b'[["anna", "desk", "e1"], ["rosie.neck.pan"], [["e2", 7]]]'


def _files() -> Iterator[tuple[str, bytes]]:
    for target, names in _TOML.items():
        for name in names:
            yield target, (EXAMPLES / name).read_bytes()
    yield "lexicon", PACKAGE.read_bytes()
    yield "gateway-file", _GATEWAY.encode()
    yield "named-files", _GATEWAY.encode()
    yield "system-file", _SYSTEM.encode()
    yield "http-tokens", _TOKENS.encode()
    yield "revoked-names", b'revoked = ["old-arm"]\n'
    yield "open-estop", msgspec.json.encode(Estop("e1", "anna/desk/e1", "smoke", 1.5))
    yield "talk-memory", b'{"rosie.turn": "arm"}'
    yield "audit-notes", b'{"container": "arm", "seq": 3, "hash": "00ff"}\n'
    yield "audit-record", _record()
    yield "backup", _backup()


def _record() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "e1.db"
        store = AuditStore(path)
        rows = [AuditRow(n, n, n, "e1", "call", "turn", "", "anna", "anna/desk/e1", n, n, "ok", "", 5) for n in (1, 2)]
        store.add(rows)
        store.close()
        file = sqlite3.connect(path)
        file.execute("PRAGMA journal_mode=DELETE")
        file.close()
        return path.read_bytes()


def _backup() -> bytes:
    kept = b"system = 'lab'\n"
    entry = ArchivedFile("config/gateway.toml", len(kept), sha256(kept).hexdigest(), 0o600, "me", "us")
    about = Manifest(1, "0.1.0", "here", "2026-01-01T00:00:00", "config/gateway.toml", [entry])
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as archive:
        for name, text in ((MANIFEST, msgspec.json.encode(about)), (entry.path, kept)):
            member = tarfile.TarInfo(name)
            member.size = len(text)
            archive.addfile(member, io.BytesIO(text))
    return made.getvalue()


def _clients() -> Iterator[tuple[str, bytes]]:
    frames: list[dict[str, Any]] = [
        {"do": "call", "id": 1, "group": "lab.desk", "name": "shine", "args": [0.5, {"a": None}]},
        {"do": "lock", "id": "a", "group": "lab", "purpose": "b", "wait_s": 1.5, "partial": True},
        {"do": "stream", "id": 2, "group": "lab", "name": "c", "hz": 20, "on_change": True},
        {"do": "watch", "id": 3, "occasions": ["joined"], "existing": True},
        *({"do": do, "id": 4, **more} for do, more in (("unlock", {"lock": "l"}), ("resume", {"group": "lab"}))),
        *({"do": do, "id": 4, **more} for do, more in (("estop", {"reason": "r"}), ("cancel", {"which": 3}))),
        *({"do": do, "id": 4, **more} for do, more in (("logs", {"level": 30}), ("calls", {"reads": True}))),
    ]
    for frame in frames:
        yield "http-frame", json.dumps(frame).encode()
    bodies = [
        {"args": {"level": 0.5}, "deadline_s": 2},
        {"group": "lab", "wait_s": 0},
        {"group": "lab"},
        {"resources": ["a"], "reason": "b"},
        {"reason": "smoke"},
        {"ids": ["e1"]},
        {"on": True},
        {"lease_s": 5},
    ]
    for number, body in enumerate(bodies[: len(BODIES)]):
        yield "http-body", bytes([number]) + json.dumps(body).encode()
    given = {
        "group": "rosie",
        "name": "turn",
        "args": [0.5],
        "why": "w",
        "purpose": "p",
        "sentence": "Who?",
        "lock": "l",
    }
    for number, tool in enumerate(TOOLS.values()):
        fields = tool.asked.__struct_fields__
        yield "agent-tool", bytes([number]) + json.dumps({k: v for k, v in given.items() if k in fields}).encode()


def _ros() -> Iterator[tuple[str, bytes]]:
    filled: dict[str, Any] = {
        "std_msgs/msg/String": {"data": "hello"},
        "sensor_msgs/msg/JointState": {"name": ["pan", "tilt"], "position": [0.5, 1.5]},
        "trajectory_msgs/msg/JointTrajectory": {"joint_names": ["a"], "points": [{"positions": [1.0]}]},
        "std_msgs/msg/Float64MultiArray": {"data": [1.0, 2.0]},
        "sensor_msgs/msg/PointCloud2": {"height": 1, "width": 1, "data": b"\x01\x02"},
    }
    for number, kind in enumerate(KINDS):
        for ros in (1, 2):
            yield f"ros{ros}-message", bytes([number]) + TYPES[ros].to_bytes(kind, filled.get(kind, {}))
    yield "ros2-attachment", Attachment(1, 2, bytes(range(16))).to_bytes()


def _frames(*frames: tuple[int, bytes]) -> bytes:
    return b"".join(bytes((head, len(data))) + data for head, data in frames)


def _buses() -> Iterator[tuple[str, bytes]]:
    status = dynamixel_packet(1, 0x55, b"\x00\x01\x02\x03\x04")
    assert dynamixel_crc(status[:-2]) == status[-2] | status[-1] << 8
    yield "dynamixel-status", status + dynamixel_packet(2, 0x55, b"\x80\xff\xff\xfd")
    yield "feetech-status", feetech_packet(1, 0, b"\x12\x34") + feetech_packet(2, 4, b"\xff\xff")
    yield "modbus-answer", b"\x02" + modbus_frame(bytes.fromhex("0904 06 F900 0003 0000"))
    yield "modbus-answer", b"\x02" + modbus_frame(bytes.fromhex("0984 02"))
    yield "cia402-sdo", bytes.fromhex("4308100041424344")
    yield "cia402-sdo", bytes.fromhex("410810000A00000000414243444546471948494A00000000")
    yield "cia402-axis", _pieces(struct.pack("<HiH", 0x1237, 1000, 5), bytes(7), bytes(8), b"\x05")
    yield "odrive-axis", _pieces(*(bytes(8) for _ in range(7)), struct.pack("<ff", 0.5, 1.0))
    yield "damiao-axis", _pieces(bytes.fromhex("117FFF7FF7FF2021"), bytes.fromhex("0100330A02000000"))
    yield "ur-dashboard-line", b"Connected: Universal Robots Dashboard Server\n"
    link = struct.pack("=BxHiII", 0, 280, 3, 1, 0)
    data = struct.pack("=HHI", 8, 4, 1) + struct.pack("=HHI", 8, 1, 500_000)
    info = struct.pack("=HH", 8 + len(data), 18) + struct.pack("=HH", 4 + len(data), 2) + data
    yield "netlink", struct.pack("=IHHII", 16 + len(link) + len(info), 16, 0, 0, 0) + link + info
    yield "picture", b"\x89PNG\r\n\x1a\n" + bytes.fromhex("0000000D49484452 00000280 000001E0") + b"IEND\xaeB`\x82"
    yield "picture", bytes.fromhex("FFD8FFE00004 0000 FFC0000B08 01E0 0280 0000 FFD9")
    requests = [dynamixel_packet(1, 1), dynamixel_packet(1, 3, struct.pack("<HB", 64, 1))]
    requests += [
        dynamixel_packet(1, 3, struct.pack("<Hi", 116, 2100)),
        dynamixel_packet(254, 0x82, bytes([132, 0, 4, 0, 1, 2])),
    ]
    requests += [
        dynamixel_packet(254, 0x8A, bytes([132, 0, 4, 0, 1, 2])),
        dynamixel_packet(1, 3, b"\x54\x00\xff\xff\xfd\x00"),
    ]
    yield "sim-dynamixel-packets", b"".join(requests)
    yield "sim-dynamixel", b"".join(requests)
    asked = [feetech_packet(1, 1), feetech_packet(1, 3, b"\x28\x01"), feetech_packet(254, 0x82, b"\x38\x06\x01\x02")]
    asked += [
        feetech_packet(1, 3, bytes([42]) + struct.pack("<HHH", 2100, 0, 500)),
        feetech_packet(254, 0x83, b"\x2a\x02\x01\x00\x08"),
    ]
    yield "sim-feetech-packets", b"".join(asked)
    yield "sim-feetech", b"".join(asked)
    words = [bytes.fromhex("0904 07D0 0003"), bytes.fromhex("0910 03E8 0003 06 0100 0000 0000")]
    words += [bytes.fromhex("0917 07D0 0003 03E8 0003 06 0900 00FF FFFF"), bytes.fromhex("0906 03E8 0100")]
    yield "sim-modbus-requests", b"".join(map(modbus_frame, words))
    yield "sim-robotiq", b"".join(map(modbus_frame, words))
    yield (
        "sim-cia402",
        _frames(
            (0, b"\x01\x00"),
            (7, bytes.fromhex("4008100000000000")),
            (7, bytes.fromhex("2B40600006000000")),
            (1, b""),
            (7, bytes.fromhex("2B40600007000000")),
            (7, bytes.fromhex("2B4060000F000000")),
            (7, bytes.fromhex("2F60600001000000")),
            (3, struct.pack("<Hi", 0x1F, 1000)),
            (9, b"\x05"),
            (7, bytes.fromhex("6000000000000000")),
        ),
    )
    odrive = [
        (128 | 0x07, struct.pack("<I", 8)),
        (128 | 0x0B, struct.pack("<II", 3, 5)),
        (128 | 0x0C, struct.pack("<fhh", 1.0, 0, 0)),
    ]
    yield (
        "sim-odrive",
        _frames(*odrive, (128 | 0x0D, struct.pack("<ff", 1.0, 0.0)), (128 | 0x17, b""), (128 | 0x18, bytes(8))),
    )
    enable, position = b"\xff" * 7 + b"\xfc", struct.pack("<ff", 0.5, 1.0)
    yield "sim-damiao", _frames((11, enable), (12, position), (10, bytes.fromhex("0100330A00000000")), (11, bytes(8)))
    yield (
        "sim-ur-rtde",
        b"\xff"
        + b"".join(
            struct.pack(">HB", 3 + len(body), ord(kind)) + body
            for kind, body in (
                ("V", b"\x00\x02"),
                ("O", struct.pack(">d", 125.0) + b"timestamp,actual_q,robot_mode"),
                ("I", b"input_int_register_0,input_double_register_0"),
                ("S", b""),
                ("U", b"\x01" + struct.pack(">id", 19, 0.5)),
            )
        ),
    )
    yield "sim-ur-dashboard", b"robotmode\nload wave.urp\nplay\nstop\npower on\n"
    yield "sim-can-text", b"< send 601 8 40 8 10 0 0 0 0 0 >< send 18FF0000 2 a b >< send 701 1 >"
    yield "sim-can-interface", struct.pack("=IB3x8s", 0x601, 8, bytes.fromhex("4008100000000000"))
    for command in (
        {"do": "state"},
        {"do": "mute", "ids": [1]},
        {"do": "bad_crc", "ids": [1], "times": 2},
        {"do": "unplug"},
    ):
        yield "sim-control", json.dumps(command).encode()


def _pieces(*pieces: bytes) -> bytes:
    return b"".join(bytes([len(piece)]) + piece for piece in pieces)


def main() -> None:
    counts = dict.fromkeys(TARGETS, 0)
    for room in (_wire(), _files(), _clients(), _ros(), _buses()):
        for name, data in room:
            counts[name] += 1
            path = TARGETS[name].folder / f"{counts[name]:02}"
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                path.write_bytes(data)


if __name__ == "__main__":
    main()
