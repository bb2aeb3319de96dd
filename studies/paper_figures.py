"""The paper's figures, drawn from the shipped scenarios.

``python studies/paper_figures.py out/paper``: runs each scenario that is not in the folder yet, and
writes one SVG a figure into ``docs/images``, or elsewhere with ``-o``. All that is drawn is read
from the sessions, as anyone would read them. With ``--quick`` the runs are short and the figures
meaningless, only to see that it runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from undulog.analysis import analyse_session
from undulog.analysis.common.estimate import Estimate
from undulog.analysis.parts.body.result import BodyPoint
from undulog.analysis.results.analysis import Analysis
from undulog.capture import Session
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_hex
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.sim import load_scenario
from undulog.sim.scenario.obstacles import Cylinder, Wall
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.scenario.world import World
from undulog.sim.twin.reactions import amplitude, bend, frequency
from undulog.sim.twin.recording import record

IMAGES = Path(__file__).parents[1] / "docs/images"
GREY = "#8c8c8c"
STONE = "#c9cdd3"
MODES = {"walk": "#e9ecef", "avoid": "#ffd8a8", "turn": "#b2f2bb", "shrink": "#d0bfff"}
OTHER_MODE = "#ffc9c9"
LAGS = ("pi2", "pi3")
QUICK_S, QUICK_GAIT_S = 2.0, 8.0
"""Durations of quick runs; those whose gait is analysed need three cycles of it."""
ABOVE = {"frameon": False, "fontsize": 8, "loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}


@dataclass(frozen=True)
class Run:
    """The drawn signals of a session.

    Attributes:
        t_s: Times of the samples [s], shape (n,).
        names: Joint names, head to tail.
        command: Commanded angles [rad], shape (n, m).
        centre: Link centres [m], shape (n, m + 1, 3).
        modes: When each mode began [s], and its name.
        world: Where it ran.
    """

    t_s: FloatArray
    names: tuple[str, ...]
    command: FloatArray
    centre: FloatArray
    modes: tuple[tuple[float, str], ...]
    world: World

    def at(self, time_s: float) -> int:
        """Index of the sample at a time; of the last one after the end, as in a quick run."""
        return min(int(np.searchsorted(self.t_s, time_s)), len(self.t_s) - 1)


class Runs:
    """Runs scenarios, each once."""

    def __init__(self, folder: Path, *, quick: bool = False) -> None:
        """Keep sessions in a folder; short ones where it is to be quick."""
        self._folder = folder
        self._quick = quick
        folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, name: str) -> Run:
        """Return the run of a shipped scenario."""
        with Session.open(self._session(name)) as session:
            return _read(session, load_scenario(name).world)

    def analysis(self, name: str) -> Analysis:
        """Return the numbers of a shipped scenario's run."""
        with Session.open(self._session(name)) as session:
            return analyse_session(session)

    def _session(self, name: str) -> Path:
        path = self._folder / f"{name}.mcap"
        if not path.exists():
            scenario = load_scenario(name)
            if self._quick:
                duration_s = QUICK_GAIT_S if name.startswith("snake13-") else QUICK_S
                scenario = dataclasses.replace(scenario, duration_s=duration_s, settle_s=0.0)
            print(f"running {name}, {scenario.duration_s:g} s ...", flush=True)
            record(scenario, path, kernels=Kernels.NUMBA if self._quick else Kernels.NUMPY)
        return path


def _read(session: Session, world: World) -> Run:
    robot = session.robot
    if robot is None:
        sys.exit(f"{session.path}: no robot description")
    angle = np.stack(session.joints("/joint_states", "position").values, axis=1)
    command = np.stack(session.joints("/joint_commands", "position").values, axis=1)
    odom = session.table("/odom")
    count = min(len(angle), len(command), len(odom))
    pose = [odom[f"pose.pose.position.{axis}"].to_numpy()[:count] for axis in "xyz"]
    turn = [odom[f"pose.pose.orientation.{axis}"].to_numpy()[:count] for axis in "xyzw"]
    angles = angle[:count]
    centre, _ = link_poses(
        robot, np.stack(pose, axis=1), rotation_from_quaternion(np.stack(turn, axis=1)), angles
    )
    start = session.start_ns
    modes = session.table("/gait/mode")
    t_s = (odom.index.to_numpy(dtype=np.int64)[:count] - start) * 1e-9
    named = tuple(
        ((int(t) - start) * 1e-9, str(text))
        for t, text in zip(modes.index, modes["data"], strict=True)
    )
    return Run(t_s, robot.joint_names, command[:count], centre, named, world)


def draw_world(ax: Axes, world: World) -> None:
    """Obstacles and target from above."""
    for obstacle in world.obstacles:
        if isinstance(obstacle, Cylinder):
            ax.add_patch(Circle(obstacle.position, obstacle.radius, color=STONE))
            continue
        box = obstacle.box if isinstance(obstacle, Wall) else obstacle
        c, s = math.cos(box.heading), math.sin(box.heading)
        half = np.array(box.size) / 2 * [[1, 1], [-1, 1], [-1, -1], [1, -1]]
        ax.add_patch(Polygon(half @ [[c, s], [-s, c]] + box.position, color=STONE))
    if world.target is not None:
        ring = Circle(world.target.position, world.target.radius, fill=False, color="#2f9e44")
        ax.add_patch(ring)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def draw_body(ax: Axes, run: Run, time_s: float, across: int = 1, **look: Any) -> None:
    """The robot's centre line at one time, its head a dot."""
    body = run.centre[run.at(time_s)]
    (line,) = ax.plot(body[:, 0], body[:, across], lw=2, solid_capstyle="round", **look)
    ax.plot(body[0, 0], body[0, across], "o", ms=4, color=line.get_color())


def shade_modes(ax: Axes, run: Run) -> None:
    """The gait's mode behind a plot over time."""
    ends = [*[time for time, _ in run.modes[1:]], float(run.t_s[-1])]
    labelled: set[str] = set()
    for (start, mode), end in zip(run.modes, ends, strict=True):
        label = None if mode in labelled else mode
        labelled.add(mode)
        ax.axvspan(start, end, color=MODES.get(mode, OTHER_MODE), lw=0, label=label, zorder=0)


def laws_figure(_: Runs) -> mpl.figure.Figure:
    """Draw three laws of the distance."""
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.8))
    d = np.linspace(0, 1.5, 301)
    for k in (1.0, 2.0, 4.0):
        axes[0].plot(d, np.degrees([bend(x, 1.0, 0.22, k) for x in d]), label=f"k = {k:g}/m")
        axes[1].plot(d, np.degrees(amplitude(d, 0.3, 0.1, k)))
        axes[2].plot(d, [frequency(x, 0.3, k) for x in d])
    axes[0].set_ylabel("f(d) [deg]")
    axes[1].set_ylabel("Ã(d) [deg]")
    axes[2].set_ylabel("ω̃(d) / ω")
    axes[0].legend(frameon=False)
    for ax in axes:
        ax.set_xlabel("distance to the obstacle d [m]")
    return figure


def paths_figure(runs: Runs) -> mpl.figure.Figure:
    """Draw random walk and target following, from above."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), sharex=True, sharey=True)
    for ax, name in zip(axes, ("random-walk", "target-following"), strict=True):
        run = runs(name)
        draw_world(ax, run.world)
        target = run.world.target
        if target is None:
            sys.exit(f"{name}: no target")
        away = np.hypot(*(run.centre[:, 0, :2] - target.position).T)
        met = np.flatnonzero(away <= target.radius)
        end = met[0] if len(met) else len(run.t_s) - 1
        ax.plot(run.centre[:end, 0, 0], run.centre[:end, 0, 1], color=GREY, lw=0.8)
        draw_body(ax, run, run.t_s[end], color="#1c7ed6")
        when = f"target met after {run.t_s[end]:.1f} s" if len(met) else "target not met"
        ax.set_title(f"{name}: {when}", fontsize=9)
    return figure


def course_figure(name: str, times: Sequence[float]) -> Callable[[Runs], mpl.figure.Figure]:
    """Draw bodies at some times from above; commands and modes over time."""

    def draw(runs: Runs) -> mpl.figure.Figure:
        run = runs(name)
        figure, (top, below) = plt.subplots(2, 1, figsize=(9, 6), height_ratios=(3, 2))
        draw_world(top, run.world)
        for time_s, color in zip(times, joint_hex(len(times)), strict=True):
            draw_body(top, run, time_s, color=color, label=f"{time_s:g} s")
        top.legend(ncols=len(times), **ABOVE)
        shade_modes(below, run)
        yaw = run.command[:, ::2]
        for i in (0, 4, 8, 12):
            color = joint_hex(13)[i]
            below.plot(run.t_s, np.degrees(yaw[:, i]), color=color, lw=1, label=run.names[2 * i])
        below.set_xlabel("time [s]")
        below.set_ylabel("command [deg]")
        below.set_xlim(0, run.t_s[-1])
        below.legend(ncols=8, **ABOVE)
        return figure

    return draw


def gaits_figure(runs: Runs) -> mpl.figure.Figure:
    """Draw bodies of the three gaits of the paper and of the 3D gaits, over one cycle."""
    names = ("horizontal", "vertical", "combined", "sidewinding", "rolling", "caterpillar")
    figure, axes = plt.subplots(2, 6, figsize=(12, 4))
    for (top, side), name in zip(axes.T, names, strict=True):
        run = runs(name)
        end = run.t_s[-1] - 0.1
        for share, color in zip(np.arange(4) / 4, joint_hex(4), strict=True):
            draw_body(top, run, end - 2.0 * (1 - share), color=color)
            draw_body(side, run, end - 2.0 * (1 - share), across=2, color=color)
        moved = run.centre[run.at(end)].mean(axis=0) - run.centre[run.at(end - 8)].mean(axis=0)
        top.set_title(f"{name}\n{np.hypot(*moved[:2]) / 8:.3f} m/s", fontsize=9)
        top.set_aspect("equal", "datalim")
        side.set_ylim(0.0, 0.3)
        side.set_xlabel("x [m]")
    axes[0, 0].set_ylabel("y [m]")
    axes[1, 0].set_ylabel("z [m]")
    return figure


def delay_figure(runs: Runs) -> mpl.figure.Figure:
    """Delay blocks against Eq. 2: equal at constant omega, after the first wave has run through."""
    blocks, wave = runs("delay-blocks"), runs("flat")
    figure, axes = plt.subplots(2, 1, figsize=(9, 4), sharex=True)
    for i in (0, 6, 12):
        color = joint_hex(13)[i]
        label = blocks.names[2 * i]
        axes[0].plot(blocks.t_s, np.degrees(blocks.command[:, 2 * i]), color=color, label=label)
        axes[0].plot(wave.t_s, np.degrees(wave.command[:, 2 * i]), "--", color=GREY, lw=1)
        count = min(len(blocks.t_s), len(wave.t_s))
        apart = blocks.command[:count, 2 * i] - wave.command[:count, 2 * i]
        axes[1].plot(wave.t_s[:count], np.degrees(apart), color=color)
    axes[0].set_xlim(0, 10)
    axes[0].set_ylabel("command [deg]")
    axes[1].set_ylabel("difference [deg]")
    axes[1].set_xlabel("time [s]")
    axes[0].legend(frameon=False, ncols=3, loc="upper right")
    return figure


def places_figure(runs: Runs) -> mpl.figure.Figure:
    """Draw head, middle and tail of 13 links, and what perfect tracking alone would give."""
    cases = [f"snake13-{plane}-{lag}" for plane in ("horizontal", "vertical") for lag in LAGS]
    figure, axes = plt.subplots(2, 4, figsize=(10, 4), sharex=True, sharey="row")
    colors = [joint_hex(13)[link] for link in (0, 6, 12)]
    for (top, below), name in zip(axes.T, cases, strict=True):
        body = runs.analysis(name).body
        if body is None:
            sys.exit(f"{name}: no body motion")
        places = [point.place for point in body.observed]
        for model, points in body.null.items():
            style = {"viscous": "--", "free": ":"}[model]
            size = [1e3 * (point.amplitude_m.value or math.nan) for point in points]
            top.plot(places, size, style, color=GREY, label=f"perfect tracking, {model}")
            turn = [_phase(point) for point in points]
            below.plot(places, turn, style, color=GREY)
        for point, color in zip(body.observed, colors, strict=True):
            size = point.amplitude_m
            dot = {"color": color, "marker": "o", "ms": 5, "capsize": 3}
            top.errorbar(point.place, 1e3 * (size.value or math.nan), _half(size, 1e3), **dot)
            half = _half(point.phase_rad, 180 / math.pi)
            below.errorbar(point.place, _phase(point), half, **dot)
        top.set_title(name.removeprefix("snake13-"), fontsize=9)
    axes[0, 0].set_ylabel("amplitude [mm]")
    axes[1, 0].set_ylabel("phase to the head [deg]")
    axes[0, 0].legend(frameon=False, fontsize=7)
    return figure


def _half(estimate: Estimate, scale: float) -> float:
    low, high = estimate.ci95 or (math.nan, math.nan)
    return scale * (high - low) / 2


def _phase(point: BodyPoint) -> float:
    return math.degrees(point.phase_rad.value if point.phase_rad.value is not None else math.nan)


FIGURES: dict[str, Callable[[Runs], mpl.figure.Figure]] = {
    "paper-laws": laws_figure,
    "paper-paths": paths_figure,
    "paper-side-sensors": course_figure("side-sensor-amplitude", (4, 7, 10, 13)),
    "paper-corridor": course_figure("corridor", (3, 7, 11, 15, 19)),
    "paper-avoidance": course_figure("avoidance", (3, 6, 8, 10, 12, 15)),
    "paper-gaits": gaits_figure,
    "paper-delay-blocks": delay_figure,
    "paper-places": places_figure,
}


def main() -> None:
    """Draw all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sessions", type=Path, nargs="?", help="folder that keeps the sessions")
    parser.add_argument("-o", dest="images", type=Path, default=IMAGES, help="folder to write to")
    parser.add_argument("--quick", action="store_true", help="short runs")
    options = parser.parse_args()
    mpl.use("Agg")
    plt.rcParams |= {"svg.hashsalt": "undulog", "font.size": 9}
    plt.rcParams |= {"axes.spines.top": False, "axes.spines.right": False}
    plt.rcParams |= {"figure.constrained_layout.use": True}
    images: Path = options.images
    images.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        runs = Runs(options.sessions or Path(temporary), quick=options.quick)
        for name, draw in FIGURES.items():
            path = images / f"{name}.svg"
            draw(runs).savefig(path, metadata={"Date": None})
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
