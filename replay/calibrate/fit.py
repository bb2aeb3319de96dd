"""Sessions' commands and joint states, and the twin's parameters that fit all of them best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from undulog.sim.scenario.scenario import Kernels, Scenario

from .answers import Answers
from .identifiability import (
    Alternative,
    CorrelatedParameters,
    alternatives,
    half_widths,
    ridges,
    suggested_recordings,
)
from .lack_of_fit import JointMisfit, LackOfFit, halves, lack_of_fit, misfit
from .least_squares import LinearFit
from .parameters import DELAY, Unknown, module_unknown, unknowns, with_values
from .recorded import check_alike, read_recorded
from .solve import Solution, solve
from .step_size import StepSize, step_size
from .weak_module import Search, find_weak_module


@dataclass(frozen=True)
class Wanted:
    """What is to be fitted.

    Attributes:
        only: Names of shared parameters; all if empty.
        module: A joint whose stall torque is its own, or None.
        spread: Prior standard deviation of each ln theta.
        within: A parameter is determined if its 95 % interval is no wider than this to either side,
            as a share of it; of a dead time: of a control period.
        settle_s: The first part to leave out [s]; the session's own if None.
    """

    only: tuple[str, ...] = ()
    module: str | None = None
    search: bool = False
    delay: bool = False
    spread: float = 0.5
    within: float = 0.05
    settle_s: float | None = None


@dataclass(frozen=True)
class FittedParameter:
    """One parameter; values in its unit, of a module its factor on the shared one.

    Attributes:
        label: How it is called in text.
        module: The joint whose own it is, or None.
        unit: SI.
        ci95: 95 % interval; None where the twin doesn't fit, since it would hold for noise alone.
        determined: Whether the session determines it.
    """

    name: str
    label: str
    module: str | None
    unit: str
    start: float
    value: float
    ci95: tuple[float, float] | None
    determined: bool


@dataclass(frozen=True)
class CalibrationResult:
    """What came of a fit.

    Attributes:
        sessions: Their files.
        world: Scenario that it started from.
        scenario: That scenario with the fitted values.
        ridges: Directions that the session leaves open.
        search: What came of the search for a module, if there was one.
        lack: Whether the twin fits at all.
        step: What half the physics step changes.
        memory: Autocorrelation time of what is left, in samples; 1 is white noise.
        iterations: Of the last fit.
        converged: Whether it came to an end.
        speed: Simulated seconds a second.
    """

    sessions: tuple[str, ...]
    world: str
    scenario: Scenario
    parameters: tuple[FittedParameter, ...]
    ridges: tuple[CorrelatedParameters, ...]
    would_tell: tuple[str, ...]
    before: dict[str, JointMisfit]
    after: dict[str, JointMisfit]
    search: Search | None
    lack: LackOfFit
    step: StepSize
    memory: float
    iterations: int
    converged: bool
    runs: int
    speed: float


def calibrate(
    paths: Sequence[Path],
    world: str | None = None,
    options: Wanted | None = None,
    *,
    topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC),
    kernels: Kernels = Kernels.NUMPY,
    on_tick: Callable[[], None] = lambda: None,
    on_iteration: Callable[[int, float, float], None] = lambda _k, _rms, _speed: None,
) -> CalibrationResult:
    """Fit the twin to one or several sessions, which share all parameters.

    Args:
        paths: The sessions: commands and joint states.
        world: Scenario to start from, by name or file; the one each was recorded in if None.
        options: What is to be fitted.
        topics: Of commands and responses.
        kernels: What computes the force laws.
        on_tick: Called at every tick of every run; may raise to end the fit.
        on_iteration: Called with each iteration, the residuals' RMS [rad] and the real-time factor.

    Raises:
        UsageError: If no world is known, sessions are of worlds that differ, or what is wanted
            isn't there.
        DataError: If the sessions have too little to fit.
        SimulationError: If the twin fails with the starting values.
        LogError: If a session can't be read.
    """
    wish = options or Wanted()
    sessions = tuple(read_recorded(path, world, wish.settle_s, topics) for path in paths)
    check_alike(sessions)
    answers = Answers(sessions, kernels, on_tick)
    scenario = answers.scenario
    shared = unknowns(scenario, spread=wish.spread, only=wish.only, delay=wish.delay)
    if wish.module is not None:
        shared = (*shared, module_unknown(scenario, wish.module, wish.spread))
    count = sum(map(len, answers.measured.angles))
    if count <= 2 * len(shared):
        names = ", ".join(map(str, paths))
        raise DataError(f"{names}: {count} settled samples are too few for {len(shared)} unknowns")

    def report_iteration(k: int, rms: float) -> None:
        on_iteration(k, rms, answers.work.speed)

    first = solution = solve(answers, shared, on_iteration=report_iteration)
    search = None
    if wish.search:
        search, with_module = find_weak_module(answers, first, wish.spread, report_iteration)
        solution = with_module if search.named else first
    return _calibration(answers, first, solution, search=search, within=wish.within)


def _lack(answers: Answers, solution: Solution, freed: LinearFit) -> LackOfFit:
    """Look at what the fit leaves, session by session."""
    counts = [len(session.measured.joints) for session in answers.sessions]
    index = np.repeat(np.arange(len(counts)), counts).tolist()
    return lack_of_fit(
        answers.measured,
        freed.problem.residuals,
        [answers.sessions[k].omega for k in index],
        halves(freed.problem, freed.x, index),
        alternatives(answers, solution, freed),
    )


def _calibration(
    answers: Answers,
    first: Solution,
    solution: Solution,
    *,
    search: Search | None,
    within: float,
) -> CalibrationResult:
    step = step_size(answers, solution)
    lack = _lack(answers, solution, step.freed(solution))
    ends = _ends(solution, lack.alternatives)
    parameters, of_this_step = (
        _all_fitted(solution, of, within, fits=not lack.significant)
        for of in (step.widened(*ends), ends)
    )
    unclear = [i for i, p in enumerate(parameters) if not (p.determined or lack.significant)]
    by_step = [i for i in unclear if of_this_step[i].determined]
    return CalibrationResult(
        sessions=tuple(str(session.path) for session in answers.sessions),
        world=answers.scenario.name,
        scenario=with_values(answers.scenario, solution.unknowns, solution.x),
        parameters=parameters,
        ridges=ridges(solution.unknowns, solution.covariance),
        would_tell=suggested_recordings(
            solution.unknowns, [i for i in unclear if i not in by_step], by_step
        ),
        before=_misfits(answers, first.before),
        after=_misfits(answers, solution.after),
        search=search,
        lack=lack,
        step=step,
        memory=solution.memory,
        iterations=solution.iterations,
        converged=solution.converged,
        runs=answers.work.runs,
        speed=answers.work.speed,
    )


def _ends(solution: Solution, others: Sequence[Alternative]) -> tuple[FloatArray, FloatArray]:
    """Ends of the 95 % intervals of x: of this law, and of those that could be the ground's."""
    half = half_widths(solution.covariance)
    low, high = solution.x - half, solution.x + half
    for other in others:
        if other.widens:
            wide, there = half_widths(other.covariance), solution.x + other.shift
            low, high = np.minimum(low, there - wide), np.maximum(high, there + wide)
    return low, high


def _all_fitted(
    solution: Solution, ends: tuple[FloatArray, FloatArray], within: float, *, fits: bool
) -> tuple[FittedParameter, ...]:
    rows = np.column_stack([solution.x, *ends]).tolist()
    return tuple(
        _fitted(unknown, x, (low, high), within, fits=fits)
        for unknown, (x, low, high) in zip(solution.unknowns, rows, strict=True)
    )


def _fitted(
    parameter: Unknown, x: float, ends: tuple[float, float], within: float, *, fits: bool
) -> FittedParameter:
    half = max(x - ends[0], ends[1] - x)
    # A dead time is no share of itself: 5 % of a control period stand for 5 %.
    wide = parameter.value(half) * 100.0 if parameter.name == DELAY else float(np.expm1(half))
    return FittedParameter(
        name=parameter.name,
        label=parameter.label,
        unit=parameter.unit,
        module=parameter.module,
        start=parameter.start,
        value=parameter.value(x),
        ci95=(parameter.value(ends[0]), parameter.value(ends[1])) if fits else None,
        determined=fits and wide <= within,
    )


def _misfits(answers: Answers, residuals: Sequence[np.ndarray]) -> dict[str, JointMisfit]:
    measured = answers.measured
    rows = zip(measured.joints, measured.times_s, measured.angles, residuals, strict=True)
    return {joint: misfit(t, angle, angle - rest) for joint, t, angle, rest in rows}
