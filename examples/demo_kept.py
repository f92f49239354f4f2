"""The part of the demo in which the gateway restarts programs that were killed."""

import os
import re
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from demo_actor import PATIENCE_S, DemoFailed
from demo_judge import AGREE_RAD, PAN, Judge, say
from demo_robot import patient
from demo_stage import HERE, Stage

import trade
from trade import Constraint, Handle, where
from trade_hil_sim import SimProcess, motion_writes

HEAD, LAMP = where(group="rosie.head"), where(group="rosie.lamp")
POSE_RAD = (0.3, -0.2)
LEVEL = 0.7


def kill_and_see(scene: Stage) -> Handle:
    """Kill a driver and a program with state, and wait for both; returns a handle of the killed driver.

    The simulator outlives its driver, as servos do, so its log shows every command in between.
    """
    with SimProcess(HERE / "head.toml", log=scene.folder / "kept.jsonl") as sim, scene.keeper(_at_ports(scene, sim)):
        judge = Judge(sim.log_path)
        shown = {"head": where(name="state", kind="JointGroup") & HEAD, "lamp": where(name="level") & LAMP}
        killed = {name: trade.find(one, wait_s=PATIENCE_S) for name, one in shown.items()}
        print("  a gateway on her computer keeps two programs up: the driver of her head, and a lamp")
        _set(judge)
        stood = _truth(sim)
        killed_s = time.monotonic()
        for name in killed:
            pid = _child(name).pid
            os.kill(pid, signal.SIGKILL)
            print(f"  {name:<4} process {pid} was killed (kill -9)")
        for name, away_s in _away(shown, killed, killed_s).items():
            print(f"  {name:<4} is served again {away_s:.2f} s after that, by process {_child(name).pid}")
        _came_back(judge, sim, stood, killed_s)
        again = trade.find(HEAD & where(name="move_to"))
        trade.call(where(name="enable", kind="JointGroup") & HEAD)  # their own watchdogs had stopped the servos
        print(f"  enabled and commanded again, the head moves to {again([0.0, 0.0])[0]:+.3f} rad")
        return killed["head"]


def _set(judge: Judge) -> None:
    """Give both a state, and wait until the gateway has saved the lamp's."""
    began_s = time.monotonic()
    trade.find(HEAD & where(name="move_to"))(list(POSE_RAD))
    judge.wait_for(lambda: judge.rests(PAN, began_s))
    trade.find(LAMP & where(name="shine"))(LEVEL)
    shone_at = time.time()
    judge.wait_for(lambda: _child("lamp").saved_at > shone_at)
    print(f"  the head looks at {POSE_RAD[0]:+.2f} rad, the lamp shines at {LEVEL}, which the gateway has saved")


def _away(shown: Mapping[str, Constraint], killed: Mapping[str, Handle], since_s: float) -> dict[str, float]:
    """Seconds until each answered again, in another boot, in order of their answers."""
    away_s: dict[str, float] = {}
    while len(away_s) < len(shown):
        if time.monotonic() - since_s > PATIENCE_S:
            raise DemoFailed(f"of {', '.join(shown)} only {', '.join(away_s) or 'none'} came back")
        for name in shown.keys() - away_s.keys():
            for service in trade.services(shown[name]):
                if service.key.address != killed[name].key.address:
                    service()
                    away_s[name] = time.monotonic() - since_s
        time.sleep(0.02)
    return away_s


def _came_back(judge: Judge, sim: SimProcess, stood: dict[str, float], killed_s: float) -> None:
    """Check that nothing moved by itself and that both have their state."""
    say("since the kill:")
    commands = motion_writes(sim.entries(), since=killed_s, bus="neck")
    now = _truth(sim)
    angles_now = ", ".join(f"{joint} at {angle:+.3f} rad" for joint, angle in now.items())
    print(f"    {len(commands)} writes that could move it; {angles_now}, as before")
    if commands or judge.moves(PAN, killed_s) or now != stood:
        raise DemoFailed(f"something moved by itself: it was at {stood}")
    angles = [state.position_rad for state in trade.call(where(name="state", kind="JointGroup") & HEAD)]
    level = trade.call(where(name="level") & LAMP)
    print(f"  the new driver reads {angles[0]:+.3f} rad off the servo; the new lamp shines at {level}, as it was saved")
    if level != LEVEL or abs(angles[0] - stood[PAN]) > AGREE_RAD:
        raise DemoFailed(f"the restored state differs from the saved one: {LEVEL} and {stood[PAN]:+.3f} rad")


def _truth(sim: SimProcess) -> dict[str, float]:
    """The joints' true positions, by the simulator."""
    return {device.joint: device.position_rad for bus in sim.control.state() for device in bus.devices}


def _child(name: str) -> Any:
    """The gateway's report on one of its programs."""
    children = trade.find(where(name="children", container="keeper"))
    return next(child for child in children() if child.name == name)


def _at_ports(scene: Stage, sim: SimProcess) -> Path:
    """A copy of the head's file that names the port of its simulation."""
    text = re.sub(r'port = "[^"]*"', f'port = "{sim.ports["neck"]}"', patient((HERE / "head.toml").read_text()))
    copy = scene.folder / "head.toml"
    copy.write_text(text)
    return copy
