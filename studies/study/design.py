"""The runs of the study: plans of sweeps, in the order in which they are made.

Plans that a person would write are TOML files in ``plans/``. Those of the kicks have a list of
phases for each run and are made here: the base gait, each phase turned up and down by ``KICK``, and
two random patterns that the matrix has to predict.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from undulog.replay.sweep.plan import Parameter, SweepPlan, read_plan
from undulog.sim.scenario.scenario import Kernels

PLANS = Path(__file__).parent / "plans"
JOINTS = "robot.chain.joints"
PHASES = "gait.horizontal.start_phase"
KICK = 0.05
"""Of one command's phase [rad]."""
HELD_OUT, PATTERNS = 0.1, 2
"""Largest phase of the random patterns [rad], and how many there are."""

QUICK_JOINTS = (9, 17)
"""5 and 9 yaw joints."""
QUICK_S = {"wave": 13.0, "wave-back": 13.0, "wave-free": 30.0, "kicks": 15.0}
"""Length of quick runs; 5 s are measured, settling is what is left."""
QUICK_POINTS = {"sobol": 20, "pair": 6, "reversal": 8}
SLICES = ("stall", "joints", "lag", "law", "friction", "gain", "amplitude", "frequency", "servo")
SLICED = tuple(f"slice-{name}" for name in SLICES)
CHAINS = (
    *((n, stall) for n in (5, 9, 13) for stall in (0.25, 1.5)),
    (17, 0.25),
    (25, 0.25),
    (17, 1.5),
    (25, 1.5),
    (35, 0.25),
)
"""Yaw joints and stall torque [N m] of the chains that are kicked."""


@dataclass(frozen=True)
class Stage:
    """A sweep of the study; its name is that of its rows' folder."""

    name: str
    plan: SweepPlan


def stages(*, quick: bool) -> Iterator[Stage]:
    """Yield the sweeps of the study; the first ones alone give a page with wider intervals."""
    kicked = [Stage(f"kicks-{n}-{stall}", kicks(n, stall)) for n, stall in CHAINS]
    if quick:
        named = ("sobol", "pair-ground", "pair-free", "reversal-forward", "reversal-back", *SLICED)
        yield from (Stage(name, _quick(name)) for name in named)
        yield from (replace(stage, plan=_short(stage.plan)) for stage in kicked[:4])
        return
    yield from kicked[:4]
    yield _part("sobol", 32)
    yield from (_part(name) for name in SLICED[:2])
    yield from (_part(f"reversal-{way}", 16) for way in ("forward", "back"))
    yield from (_part(f"pair-{world}", 16) for world in ("ground", "free"))
    yield kicked[4]
    yield from (_part(name) for name in SLICED[2:])
    yield _part("sobol", 96)
    yield from kicked[5:8]
    yield from (_part(f"reversal-{way}") for way in ("forward", "back"))
    yield from (_part(f"pair-{world}") for world in ("ground", "free"))
    yield _part("sobol")
    yield from kicked[8:]


def kicks(n: int, stall: float) -> SweepPlan:
    """Return the plan of a kick experiment around the gait of ``plans/kicks.toml``."""
    random = np.random.default_rng(n)
    turned = KICK * np.eye(n)
    phases = [np.zeros(n), *turned, *-turned, *random.uniform(-HELD_OUT, HELD_OUT, (PATTERNS, n))]
    return SweepPlan(
        "kicks.toml",
        kernels=Kernels.NUMBA,
        parameters=(
            Parameter(JOINTS, (2 * n - 1,)),
            Parameter("servo.stall_torque", (stall,)),
            Parameter(PHASES, tuple((phase + 0.0).tolist() for phase in phases)),
        ),
    )


def _part(name: str, points: int | None = None) -> Stage:
    plan = read_plan(PLANS / f"{name}.toml")
    return Stage(name, replace(plan, points=points or plan.points))


def _quick(name: str) -> SweepPlan:
    """Return a plan's short form: fewer points, 5 and 9 yaw joints; of a slice its ends."""
    plan = _short(read_plan(PLANS / f"{name}.toml"))
    if name in SLICED:
        longest = QUICK_JOINTS[-1:]
        fewer = tuple(
            replace(
                parameter,
                values=longest
                if parameter.key == JOINTS
                else (parameter.values[0], parameter.values[-1]),
            )
            for parameter in plan.parameters
        )
        joints = (Parameter(JOINTS, longest),) if name == "slice-servo" else ()
        if name == "slice-joints":
            fewer = (Parameter(JOINTS, QUICK_JOINTS),)
        return replace(plan, parameters=(*fewer, *joints))
    short = tuple(
        replace(parameter, values=QUICK_JOINTS) if parameter.key == JOINTS else parameter
        for parameter in plan.parameters
    )
    return replace(plan, points=QUICK_POINTS[name.partition("-")[0]], parameters=short)


def _short(plan: SweepPlan) -> SweepPlan:
    return replace(plan, duration_s=QUICK_S[Path(plan.scenario).stem])
