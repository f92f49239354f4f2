"""The plots of a soak: what each process had over time, and how long calls took."""

import itertools
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from tests.endurance.soak.judge import Run, by_process

_KINDS = (("rss_mib", "memory, MiB"), ("threads", "threads"), ("files", "open files"))


def draw(run: Run, file: Path) -> None:
    """Write them as SVG."""
    mpl.rcParams["svg.hashsalt"] = "trade"
    figure = Figure(figsize=(10, 14), layout="constrained")
    panels = figure.subplots(len(_KINDS) + 2, 1, sharex=True)
    for panel, (kind, label) in zip(panels, _KINDS, strict=False):
        for process, samples in by_process(run.samples).items():
            times_min = [sample.t / 60 for sample in samples]
            panel.plot(times_min, [getattr(sample, kind) for sample in samples], label=process, linewidth=1)
        panel.set_ylabel(label)
        panel.set_ylim(bottom=0)
    load, calls = panels[len(_KINDS) :]
    for process, samples in by_process(run.samples).items():
        pairs = list(itertools.pairwise(samples))
        share = [(later.cpu_s - earlier.cpu_s) / max(later.t - earlier.t, 1e-9) for earlier, later in pairs]
        load.plot([later.t / 60 for _, later in pairs], share, label=process, linewidth=1)
    load.set_ylabel("processors")
    for planner in sorted({said.planner for said in run.said}):
        own = [said for said in run.said if said.planner == planner and said.p50_us]
        [line] = calls.plot([said.t / 60 for said in own], [said.p50_us / 1e3 for said in own], label=planner)
        calls.plot(
            [said.t / 60 for said in own], [said.p99_us / 1e3 for said in own], color=line.get_color(), linestyle=":"
        )
    calls.set_yscale("log")
    calls.set_ylabel("a call, ms (dotted: p99)")
    calls.set_xlabel("minutes")
    panels[0].legend(fontsize="small", ncols=3)
    calls.legend(fontsize="small", ncols=3)
    figure.savefig(file, metadata={"Date": None})
