"""A witness: when one robot has a fault, it takes a picture with another one's camera as evidence.

Each in a terminal of its own; the rule in witness.toml says when:

    trade up examples/dora.toml --sim
    trade up examples/eye.toml --sim
    python examples/witness.py pictures
    trade rules run examples/witness.toml
"""

import sys
import threading
from datetime import datetime
from pathlib import Path
from typing import Any

import trade
from trade import Handle, Settings, errors, service, where


class Witness:
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @service(effect="note")
    def look_into(self, about: Handle) -> str:
        """Take a picture of a faulty device with another robot's camera; returns the picture's path."""
        device = about.groups[0]
        robot = device.partition(".")[0]
        fault = self._newest(robot, device)
        camera = self._camera_beside(robot)
        image: Any = camera()
        picture = self._folder / f"{fault.id}-{fault.count}.{image.format}"
        picture.write_bytes(image.data)
        seen = f"seen by {camera.groups[0]} at {datetime.now().astimezone().isoformat(timespec='seconds')}: {picture}"
        trade.find(where(name="add_evidence", group=f"{robot}.faults"))(fault.id, seen)
        print(f"{fault.text}; {seen}", flush=True)
        return str(picture)

    def _newest(self, robot: str, device: str) -> Any:
        known = trade.find(where(name="faults", group=f"{robot}.faults"))()
        found = [fault for fault in known if fault.device == device]
        if not found:
            raise errors.ConfigurationError(where=device, problem="has had no fault")
        return found[0]

    def _camera_beside(self, robot: str) -> Handle:
        cameras = trade.services(where(name="image", kind="Camera", healthy=True) & ~where(group=robot))
        if not cameras:
            raise errors.ConfigurationError(where=robot, problem="no other robot has a healthy camera")
        return cameras[0]


if __name__ == "__main__":
    folder = Path(sys.argv[1]).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    trade.start(Settings.read(container="witness"))
    [handle] = trade.register(Witness(folder), "witness")
    print(f"ready: {handle.label}", flush=True)
    threading.Event().wait()
