"""A robot, a gateway, a dashboard and planners for hours: nothing may grow, fail or stop.

Rosie is simulated with all her devices on a network of her own; on another one six planners lock and move a part each,
a page follows her joints, and all the time a container joins, looks around and leaves, every other one killed. Writes
samples and plots; prints what grew and what was wrong, and exits with 1 if something was.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, Final

import msgspec
import psutil
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.endurance.soak.judge import Run, Said, Sample, by_process, growth, judge
from tests.endurance.soak.planner import GROUPS, PARTS
from tests.endurance.soak.plot import draw
from tests.support.lock_log import Verdict
from trade_drivers import load

ROOT: Final = Path(__file__).parents[3]
sys.path.insert(0, str(ROOT / "examples"))
from demo_page import http_gateway  # noqa: E402 - the examples are no package
from demo_stage import POLICY, ROBOT, Actor, DemoFailed, Stage, stage  # noqa: E402

_PLANNER: Final = Path(__file__).with_name("planner.py")
_OFFERING: Final = 'call = ["rosie", "lab"]\nlock = ["rosie"]\nregister = ["lab"]\ninstrument = ["lab"]'
"""Planners offer something of their own now and then."""
_SAMPLE_S: Final = 5.0
_PASSER_EVERY_S: Final = 15.0
_PASSER_S: Final = 60.0
_BEFORE_KILL_S: Final = 2.0
_JOIN_S: Final = 120.0


class Soak:
    """One run."""

    def __init__(self, scene: Stage, parts: list[str]) -> None:
        self._scene = scene
        self._parts = parts
        self.run = Run()
        self._began = time.monotonic()
        self._ended = threading.Event()
        self._reported = 0.0
        self._known = set[str]()
        """What went wrong, and was reported."""

    def now(self) -> float:
        return time.monotonic() - self._began

    def go(self, seconds: float) -> None:
        """All of it; raises DemoFailed: something did not come up."""
        with ExitStack() as stack:
            url, token = stack.enter_context(http_gateway(self._scene))
            planners = {part: stack.enter_context(self._scene.behaviour(str(_PLANNER), part)) for part in self._parts}
            self._began = time.monotonic()
            stack.enter_context(self._beside(self._follow, url, token))
            stack.enter_context(self._beside(self._pass_by))
            for part, actor in planners.items():
                stack.enter_context(self._beside(self._listen, part, actor))
            while self.now() < seconds:
                self._sample()
                self._tell(seconds)
                self._ended.wait(_SAMPLE_S)
            self.run.seconds = self.now()
            self._ended.set()
            for part, actor in planners.items():
                actor.close()
                if code := actor.process.returncode:
                    self.run.complaints.append(f"planner {part} ended with exit code {code}")

    @contextmanager
    def _beside(self, what: Any, *words: Any) -> Generator[None]:
        def run() -> None:
            try:
                what(*words)
            except Exception as error:  # noqa: BLE001 - whatever it is, the run reports it
                self.run.complaints.append(f"{what.__name__}: {type(error).__name__}: {error}")

        thread = threading.Thread(target=run, name=what.__name__)
        thread.start()
        try:
            yield
        finally:
            self._ended.set()
            thread.join(_JOIN_S)

    def _listen(self, part: str, actor: Actor) -> None:
        with suppress(DemoFailed):  # it has ended, which is looked at elsewhere
            while True:
                self.run.said.append(Said(t=self.now(), planner=part, **json.loads(actor.line())))

    def _follow(self, url: str, token: str) -> None:
        """As the page does."""
        socket = connect(url.replace("http", "ws", 1) + "/ws", additional_headers={"Authorization": f"Bearer {token}"})
        with socket:
            for number, part in enumerate(self._parts):
                group = f"rosie.{GROUPS[part]}"
                socket.send(json.dumps({"do": "stream", "id": number, "group": group, "name": "state", "hz": 10}))
            silent = 0
            while not self._ended.is_set():
                try:
                    reported = json.loads(socket.recv(timeout=1))
                except TimeoutError:
                    silent += 1
                    continue
                except ConnectionClosed as closed:
                    self.run.complaints.append(f"the page was cut off at {self.now():.0f} s: {closed}")
                    return
                if "problem" in reported:
                    self.run.complaints.append(f"the page was sent {reported} at {self.now():.0f} s")
                    return
            if silent > 0.1 * self.now():
                self.run.complaints.append(f"the page heard nothing for {silent} s")

    def _pass_by(self) -> None:
        for turn in count(1):
            if self._ended.wait(_PASSER_EVERY_S):
                return
            words = [sys.executable, _PLANNER, "passer"]
            environment = {**os.environ, **self._scene.environment("lab", "planner")}
            passer = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, start_new_session=True)
            self.run.passers += 1
            try:
                if turn % 2:
                    if code := passer.wait(_PASSER_S):
                        self.run.complaints.append(f"who passed by at {self.now():.0f} s ended with {code}")
                else:
                    self._ended.wait(_BEFORE_KILL_S)
            except subprocess.TimeoutExpired:
                self.run.complaints.append(f"who passed by at {self.now():.0f} s did not end")
            finally:
                passer.kill()
                passer.wait()

    def _sample(self) -> None:
        for process in psutil.Process().children(recursive=True):
            with suppress(psutil.NoSuchProcess):
                if name := _named(process.cmdline()):
                    with process.oneshot():
                        times, memory = process.cpu_times(), process.memory_info()
                        self.run.samples.append(
                            Sample(
                                t=self.now(),
                                process=name,
                                pid=process.pid,
                                rss_mib=memory.rss / 2**20,
                                files=process.num_fds(),
                                threads=process.num_threads(),
                                cpu_s=times.user + times.system,
                            )
                        )

    def _tell(self, seconds: float) -> None:
        if time.monotonic() - self._reported < 60:
            return
        self._reported = time.monotonic()
        last = {said.planner: said for said in self.run.said}
        errors = {f"{name}: {error}": count for name, said in last.items() for error, count in said.errors.items()}
        print(f"{self.now() / 60:.0f} of {seconds / 60:.0f} min, {sum(errors.values())} errors", flush=True)
        for error in errors.keys() - self._known:
            print(f"  {error}", flush=True)
        self._known |= errors.keys()


def _named(command: list[str]) -> str:
    """What a process of the run is; nothing if it is of no interest."""
    words = [word.rpartition("/")[2] for word in command]
    if "planner.py" in words:
        part = words[words.index("planner.py") + 1]
        return "" if part == "passer" else f"planner {part}"
    if "trade_hil_sim" in words:
        return "simulator"
    if "trade_gateway" not in words:
        return ""
    return {"up": "driver", "gateway": "gateway", "http": "page"}.get(words[words.index("trade_gateway") + 1], "")


def _bus(part: str) -> str:
    return {"head": "neck"}.get(part, part)


def _report(run: Run, verdict: Verdict) -> None:
    for what, number in sorted(verdict.counts.items()):
        print(f"  {what:32} {number:8}")
    print(f"  {'':32} {'MiB':>8} {'files':>8} {'threads':>8}   in the end; what came since the second quarter")
    for process, samples in by_process(run.samples).items():
        last, more = samples[-1], growth(samples, run.seconds)
        print(f"  {process:32} {last.rss_mib:8.1f} {last.files:8} {last.threads:8}", end="   ")
        print(", ".join(f"{much:+.1f} {kind}" for kind, much in more.items()))
    for violation in verdict.violations:
        print(f"VIOLATION: {violation}")
    print(f"{run.seconds / 3600:.2f} hours, {len(verdict.violations)} violations")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.endurance.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--parts", default=",".join(PARTS), help="of the robot, each with a planner; no others are up")
    parser.add_argument(
        "--loopback", action="store_true", help="on loopback addresses, also where there could be namespaces"
    )
    parser.add_argument(
        "--patience",
        type=float,
        default=0.01,
        help="share of a planner's rounds that may lose a device for a moment, as the computer did not get round to it",
    )
    parser.add_argument("--json", type=Path, default=Path("build/soak.json"), help="where to leave the samples")
    parser.add_argument("--svg", type=Path, default=Path("build/soak.svg"), help="where to leave the plots")
    options = parser.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    policy = POLICY.replace('call = ["rosie"]\nlock = ["rosie"]', _OFFERING)
    with tempfile.TemporaryDirectory(prefix="trade-soak-") as folder, ExitStack() as stack:
        scene = stack.enter_context(stage(Path(folder), loopback=options.loopback, policy=policy))
        parts = [part for part in options.parts.split(",") if _bus(part) not in scene.left_out]
        unused = {bus.name for bus in load(ROBOT).buses} - {_bus(part) for part in parts}
        scene.left_out |= dict.fromkeys(unused, "not asked for")
        stack.enter_context(scene.robot(Path(os.devnull)))
        soak = Soak(scene, parts)
        soak.run.patience = options.patience
        soak.go(options.hours * 3600)
        complaints = scene.complaints()
    verdict = judge(soak.run)
    for file in (options.json, options.svg):
        file.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_bytes(msgspec.json.encode(soak.run))
    draw(soak.run, options.svg)
    _report(soak.run, verdict)
    if verdict.violations:
        print("".join(complaints), file=sys.stderr)
    return bool(verdict.violations)


if __name__ == "__main__":
    sys.exit(main())
