"""The main job, on simulated hardware: behaviours on one network use a robot on another one, through a gateway.

Processes: the simulated devices, the driver container, the gateway, the behaviours. The demo compares what they
print with the simulator's own log of what the devices did, and fails if they disagree.

    make demo                    the story, then everything ends
    make demo ARGS=--stay        and the robot stays up for you to play with
    make demo ARGS=--loopback    on loopback addresses, also where there could be network namespaces
    make demo ARGS="--record demo.mcap"    and all that happens is recorded (docs/recordings.md)
"""

import argparse
import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from demo_actor import PATIENCE_S, DemoFailed
from demo_busy import busy_here
from demo_judge import PAN, Judge
from demo_kept import kill_and_see
from demo_page import dashboard
from demo_robot import patient
from demo_stage import ROBOT, Stage, stage

import trade
from trade import Settings, errors, where
from trade_hil_sim import SimControl

LOOKS_RAD = (0.6, -0.6, 0.0)
OBJECT_M = 0.04
ALL_THE_WAY_RAD = 1.2
HEAD = where(group="rosie.head")


class Options(argparse.Namespace):
    """The options of the command line."""

    stay: bool
    loopback: bool
    mute: bool
    record: Path | None


def title(number: int, what: str, why: str) -> None:
    print(f"\n{number}. {what}\n   {why}\n")


def look_around(scene: Stage, judge: Judge) -> None:
    title(1, "A behaviour finds a head", "It asks for what it needs, not for an address; a limit is refused unsent.")
    began_s = time.monotonic()
    with scene.behaviour("look_around.py") as looking:
        looking.hear_out()
    judge.looked(LOOKS_RAD, began_s)


def visit(scene: Stage) -> None:
    title(2, "A visitor may read, but not move", "The policy is a file; certificates prove identities.")
    for words in (("call", "rosie.head.joints"), ("call", "rosie.head.move_to", "[0.3, 0.0]")):
        print(f"  visitor$ trade {' '.join(words)}")
        said = scene.command("visitor", *words)
        print("\n".join(f"    {line}" for line in said.splitlines()))
        if ("AccessDenied" in said) != (words[1] == "rosie.head.move_to"):
            raise DemoFailed("the policy says otherwise")


def arbitrate(scene: Stage, judge: Judge) -> None:
    title(
        3,
        "Two behaviours want the same head",
        "One asks, one releases. A dead client loses its lock.",
    )
    with scene.behaviour("who_has_the_head.py", "find-target") as finding:
        finding.hear("I have the head")
        with scene.behaviour("who_has_the_head.py", "navigate") as navigating:
            navigating.hear("has the head, for 'finding a target'")
            finding.hear("I have let go")
            navigating.hear("I have the head")
            judge.wait_for(lambda: judge.moving(PAN))  # the sweep before has ended, else it would not have the head
            killed_s = time.monotonic()
            navigating.process.kill()
            rests = judge.wait_for(lambda: judge.rests(PAN, killed_s))
    print(f"  navigate was killed (kill -9); {rests[0].t - killed_s:.3f} s later the pan servo was at rest")
    with trade.lock(HEAD, purpose="a look at the end", wait_s=10):
        print(f"  {time.monotonic() - killed_s:.3f} s after the kill the demo itself has the head")


def walk(scene: Stage, judge: Judge) -> None:
    title(4, "Rosie walks", "One lock over both legs, one over the head. A third behaviour learns who has the legs.")
    with scene.behaviour("walk.py", "watch") as watching:
        watching.hear("I have the head")
        began_s = time.monotonic()
        with scene.behaviour("walk.py", "walk") as walking:
            walking.hear("I have both legs")
            with scene.behaviour("walk.py", "kick") as kicking:
                kicking.hear("has the legs")
                kicking.hear("refused")
                kicking.hear_out()
            stood_s = walking.hear("I stand")
            walking.hear_out()
        watching.hear("looked")
    judge.walked(began_s, stood_s)


def greet(scene: Stage, judge: Judge, control: SimControl) -> None:
    title(5, "Rosie greets", "Two arms and a tail by three vendors, on three kinds of wire, move under one lock.")
    began_s = time.monotonic()
    with scene.behaviour("greet.py") as greeting:
        greeting.hear("one lock")
        greeting.hear_out()
    judge.greeted(began_s, control, with_left="left_arm" not in scene.left_out)


def grip(scene: Stage, control: SimControl) -> None:
    title(6, "The left hand grips", "A gripper is a service like any other; it is never activated by itself.")
    control.put(OBJECT_M, bus="hand")
    with scene.behaviour("grip.py") as gripping:
        gripping.hear("holding")
        gripping.hear_out()
    truth = control.gripper("left.hand")
    print(f"  the simulator: an object of {OBJECT_M * 1e3:.0f} mm is held: {truth.holding}")
    if not truth.holding:
        raise DemoFailed("the hand says that it holds something, and it does not")


def stop_everything(judge: Judge) -> None:
    title(7, "Everything stops", "An e-stop reaches every container and holds until it is cleared. Not safety-rated.")
    look = trade.find(HEAD & where(name="move_to"))
    look([-ALL_THE_WAY_RAD, 0.0])
    began_s = time.monotonic()
    moving = look.with_(deadline_s=PATIENCE_S).start([ALL_THE_WAY_RAD, 0.0], speed_rad_s=0.3)
    judge.wait_for(lambda: judge.moves(PAN, began_s))
    pressed_s = time.monotonic()
    report = trade.estop("smoke")
    rest = judge.wait_for(lambda: judge.rests(PAN, pressed_s))[0]
    print(f"  e-stop: all confirmed it: {report.complete}; {rest.t - pressed_s:.3f} s later the servo was at rest")
    if not report.complete or (rest.position_rad or 0.0) > ALL_THE_WAY_RAD / 2:
        raise DemoFailed(f"the e-stop did not stop everything: {report}")
    expect(errors.TradeError, moving.result)
    expect(errors.Stopped, lambda: look([0.0, 0.0]))
    print(f"  cleared: {trade.estop_clear([report.id]).complete}; and it moves again: {look([0.0, 0.0])[0]:+.3f} rad")


def come_back(scene: Stage, look: trade.Handle) -> None:
    title(
        8,
        "Killed programs restart",
        "They restore their state. Nothing moves by itself.",
    )
    expect((errors.ServiceGone, errors.ContainerLost), lambda: look([0.0, 0.0]))
    expect((errors.ServiceGone, errors.ContainerLost), kill_and_see(scene))


def expect(kind: type[Exception] | tuple[type[Exception], ...], act: Callable[[], object]) -> None:
    """Check that an action is refused."""
    try:
        act()
    except kind as refused:
        print(f"  {type(refused).__name__}: {refused}")
    else:
        raise DemoFailed("a call went through that should have been refused")


def tell(scene: Stage, recording: contextlib.ExitStack, options: Options) -> None:
    log, rosie = scene.folder / "bytes.jsonl", scene.folder / ROBOT.name
    rosie.write_text(patient(ROBOT.read_text(encoding="utf-8")), encoding="utf-8")
    with scene.robot(log, rosie) as ready, SimControl(ready["control"]) as control:
        print(f"\nRosie is up on her network: head, arms, hand, legs and tail; {len(ready['services'])} services.")
        print("This computer simulates her. So her buses have lower rates and longer time-outs than in rosie.toml.")
        for bus, missing in scene.left_out.items():
            print(f"Left out: bus {bus}. Not installed: {missing}, of which there are no wheels for every platform.")
        if options.record:
            recording.enter_context(scene.recorder(options.record, rosie))
            print(f"All that she does from now on is recorded to {options.record}.")
        if options.mute:
            control.mute(bus="neck")
            print("The simulator was muted: the servos of the head no longer answer.")
        judge = Judge(log)
        trade.start(Settings.read(container="demo"))
        look_around(scene, judge)
        visit(scene)
        arbitrate(scene, judge)
        walk(scene, judge)
        greet(scene, judge, control)
        grip(scene, control)
        stop_everything(judge)
        look = trade.find(HEAD & where(name="move_to"))
        if options.stay:
            wait_for_the_user(scene)
            return
    come_back(scene, look)


def wait_for_the_user(scene: Stage) -> None:
    script = scene.folder / "lab.sh"
    script.write_text("".join(f"export {name}='{value}'\n" for name, value in scene.environment("lab", "anna").items()))
    print("\nThe robot stays up; Ctrl-C here ends it. In another terminal, on the laboratory's network:\n")
    way = [scene.places.way_in(), "source .venv/bin/activate", f"source {script}", "trade services --group rosie"]
    way += ["trade call rosie.head.move_to '[0.3, -0.2]'", "trade call rosie.left.hand.open", "trade locks"]
    print("\n".join(f"  {line}" for line in way if line))
    with contextlib.suppress(KeyboardInterrupt), dashboard(scene) as (url, token):
        print(f"\nOr in a browser: {url}\n  token: {token}")
        print("  Open it, sign in with the token, and hold + of neck.pan: the head turns while you do.")
        while True:
            time.sleep(1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stay", action="store_true", help="keep the robot up until Ctrl-C")
    parser.add_argument("--loopback", action="store_true", help="take loopback addresses for the networks")
    parser.add_argument("--mute", action="store_true", help="mute the simulated servos: the demo must fail")
    parser.add_argument("--record", type=Path, metavar="FILE.mcap", help="record all that happens to this new file")
    options = parser.parse_args(namespace=Options())
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    signal.signal(signal.SIGTERM, _interrupted)
    began_s = time.monotonic()
    try:
        with (
            tempfile.TemporaryDirectory(prefix="trade-demo-") as folder,
            stage(Path(folder), loopback=options.loopback) as scene,
        ):
            print("\n".join(scene.places.description()))
            try:
                with contextlib.ExitStack() as recording:
                    tell(scene, recording, options)
            except DemoFailed:
                print("".join(scene.complaints()), file=sys.stderr)
                raise
            finally:
                trade.close()
    except (DemoFailed, errors.TradeError, subprocess.SubprocessError) as failed:
        print(f"\nthe demo failed: {failed}", file=sys.stderr)
        if reason := busy_here():
            print(reason, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print(f"\nDone in {time.monotonic() - began_s:.0f} s. The log of the devices confirms every line above.")
    print("Next: make demo ARGS=--stay and play with it; you saw examples/walk.py and who_has_the_head.py;")
    print("docs/guide.md shows how to write such programs, docs/access-control.md how to set up gateway and policy.")
    return 0


def _interrupted(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
