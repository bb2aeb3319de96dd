"""Fleets of the twin in which one joint wears, or none: is it named, with its date?

A robot of seven yaw joints, whose servos differ by 5 %, crawls 60 times in 60 days, on floors whose
friction differs by 10 % and with encoder noise of its own each time, in one of two gaits. From a
day on the servo of one joint has less stall torque (``--wear``). Each run is analysed as a session
is; the rows go to the fleet report. Bars: joint and date within the interval in 90 % of the fleets
with wear; a joint named in at most 5 % of those without.

A fleet takes about 60 runs for each of the two cases. Run: python bench/fleet.py [--seeds 50]
"""

from __future__ import annotations

import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from measuring import arguments
from records import verdict

from undulog.analysis import analyse_session
from undulog.analysis.catalog.fleet import analyse_fleet
from undulog.analysis.catalog.rows import Row, result_rows
from undulog.capture import Session
from undulog.sim import record
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.scenario.scenario_file import parse_scenario

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support import twin_chains

JOINTS, SESSIONS, DAYS, STALL = 7, 60, 60, 0.25
FIRST = pd.Timestamp("2026-01-01")
GAITS = (0.3, 0.4)
"""Amplitudes [rad]."""

Rows = tuple[Row, list[Row]]


def _run(folder: Path, changes: dict[str, Any], seed: int) -> Rows:
    scenario = parse_scenario(
        (folder / "wave.toml").read_text(), folder / "wave.toml", None, changes
    )
    path = folder / "run.mcap"
    record(scenario.changed(seed=seed), path, kernels=Kernels.NUMBA, force=True)
    with Session.open(path) as session:
        return result_rows(analyse_session(session).to_dict())


def _tables(runs: list[Rows], days: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The sessions and joints of a catalogue that has these runs on these days."""
    sessions, joints = list[Row](), list[Row]()
    for k, ((analysis, of_joints), day) in enumerate(zip(runs, days, strict=True)):
        facts = {"path": f"run{k:02d}", "status": "analysed", "robot": "chain", "duration_s": 5.0}
        start = FIRST + pd.Timedelta(days=float(day))
        sessions.append({**analysis, **facts, "start": start, "changes": None})
        joints.extend({**row, "path": facts["path"]} for row in of_joints)
    return pd.DataFrame(sessions), pd.DataFrame(joints)


def _write(folder: Path) -> None:
    servo = {"stall_torque": STALL, "gear_stiffness": 12.0, "gear_damping": 0.008}
    robot = twin_chains.chain(JOINTS, planes=["horizontal"], **servo)
    scenario = twin_chains.wave(
        duration_s=5.0,
        settle_s=1.0,
        gait={"ramp_s": 0.5},
        horizontal={"amplitude": 0.3, "frequency_hz": 1.0, "lag": 1.0},
        noise={"position": 0.002},
    )
    (folder / "chain.toml").write_text(robot)
    (folder / "wave.toml").write_text(scenario)


@dataclass(frozen=True)
class Fleet:
    """Runs of one robot without and with wear.

    Attributes:
        days: When the runs were made, ascending.
        at: Number of the first run with wear.
    """

    days: np.ndarray
    at: int
    worn: str
    sound: list[Rows]
    aged: list[Rows]


def simulate(seed: int, wear: float, engine: str) -> Fleet:
    """Simulate one fleet without and with wear.

    Args:
        wear: Share of the stall torque that is lost.
    """
    rng = np.random.default_rng(seed)
    days = np.sort(rng.uniform(0, DAYS, SESSIONS))
    at, worn = int(rng.integers(10, SESSIONS - 10)), f"joint{rng.integers(JOINTS) + 1:02d}"
    strength = STALL * (1 + 0.05 * rng.normal(size=JOINTS))
    torques = {f"servo_of.joint{j + 1:02d}.stall_torque": float(s) for j, s in enumerate(strength)}
    key = f"servo_of.{worn}.stall_torque"
    sound, aged = list[Rows](), list[Rows]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write(folder)
        for k in range(SESSIONS):
            changes = torques | {
                "engine": engine,
                "gait.horizontal.amplitude": float(rng.choice(GAITS)),
                "world.ground.mu_normal": float(0.5 * (1 + 0.1 * rng.normal())),
            }
            sound.append(_run(folder, changes, seed * 1000 + k))
            weaker = changes | {key: torques[key] * (1 - wear)}
            aged.append(sound[-1] if k < at else _run(folder, weaker, seed * 1000 + k))
    return Fleet(days, at, worn, sound, aged)


def judge(fleet: Fleet) -> tuple[bool, str, bool]:
    """Hold the report of a fleet to the truth.

    Returns:
        Whether the worn joint is named with its date; what was found; whether a joint is named
        without wear.
    """
    before, begun = (
        FIRST + pd.Timedelta(days=float(fleet.days[k])) for k in (fleet.at - 1, fleet.at)
    )
    robots = analyse_fleet(*_tables(fleet.aged, fleet.days)).robots
    first = next((change for robot in robots for change in robot.changes), None)
    within = (
        first is not None
        and first.joint == fleet.worn
        and pd.Timestamp(first.earliest) <= begun
        and pd.Timestamp(first.latest) >= before
    )
    reported = "nothing" if first is None else f"{first.joint} {first.quantity} since {first.date}"
    robots = analyse_fleet(*_tables(fleet.sound, fleet.days)).robots
    return (
        within,
        f"{fleet.worn} since {begun:%F}: {reported}",
        any(robot.changes for robot in robots),
    )


def _judged(seed: int, wear: float, engine: str) -> tuple[bool, str, bool]:
    return judge(simulate(seed, wear, engine))


def main() -> None:
    """Print each fleet and the shares."""
    parser = arguments(__doc__, seeds=50, workers=2)
    parser.add_argument("--wear", type=float, default=0.15, help="share of the torque lost")
    parser.add_argument("--engine", default="bullet", help="bullet or mujoco")
    given = parser.parse_args()
    named = false = 0
    with ProcessPoolExecutor(given.workers, mp_context=get_context("spawn")) as pool:
        for seed, (within, text, mistaken) in enumerate(
            pool.map(partial(_judged, wear=given.wear, engine=given.engine), range(given.seeds))
        ):
            named, false = named + within, false + mistaken
            without = "; without wear: a joint, MISTAKEN" if mistaken else ""
            print(f"{seed:3d}  {'ok  ' if within else 'MISS'}  {text}{without}", flush=True)
    verdict(
        "worn joint named, date within its interval", 100 * named / given.seeds, 90, "%", most=False
    )
    verdict("a joint named without wear", 100 * false / given.seeds, 5, "%")


if __name__ == "__main__":
    main()
