"""A session's commands and joint states, and the twin's parameters that fit them best.

Which single module's servo differs? Each is freed by itself; the best one is fitted, and tested.

At the fit of the shared parameters a module's own factor would lessen Q by about b_j^2 (A_j^-1)_jj,
b_j its column's product with the weighted residuals and A_j the normal matrix with that column. The
largest is fitted in full; its p-value is that of its logarithm over its standard error, times the
number of modules that were tried (Bonferroni).

The result can be written: the robot with its fitted servo, the scenario with the fitted ground. A
robot description is what all modules are meant to be, so a module that differs goes into the
scenario's ``servo_of``, as the ground does.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import tomlkit

from undulog.analysis.session.analyse import measure_session
from undulog.capture import Session, SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import plain
from undulog.capture.common.errors import DataError, UndulogError
from undulog.capture.common.files import part_file, write_text
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Robot
from undulog.sim.scenario.scenario import Kernels, Modules, Scenario

from ..reproduce import find_repetition
from .identifiability import (
    Alternative,
    CorrelatedParameters,
    alternatives,
    half_widths,
    ridges,
    suggested_recordings,
)
from .lack_of_fit import LackOfFit, Misfit, halves, lack_of_fit, misfit
from .parameters import (
    DELAY,
    Answers,
    Unknown,
    module_unknown,
    read_measured,
    unknowns,
    with_values,
)
from .solve import LeastSquares, Solution, derivatives, solve

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Search:
    """What came of it.

    Attributes:
        module: The joint that fits best with a servo of its own.
        p: Family-wise p-value.
    """

    module: str
    p: float
    tried: int

    @property
    def named(self) -> bool:
        """Whether it is shown to differ."""
        return self.p < SIGNIFICANT


def find_weak_module(
    answers: Answers,
    shared: Solution,
    spread: float,
    on_iteration: Callable[[int, float], None],
) -> tuple[Search, Solution]:
    """Try every module.

    Args:
        answers: The twin under the commands.
        shared: The fit of identical modules.
        spread: Prior standard deviation of a module's ln factor.
        on_iteration: As :func:`.replay.calibrate.solve.solve` has it.

    Returns:
        The search, and the fit with that module's own factor.
    """
    joints = answers.measured.joints
    gains: list[float] = []
    for joint in joints:
        wanted = (*shared.unknowns, module_unknown(answers.scenario, joint, spread))
        own = derivatives(answers, wanted, np.append(shared.x, 0.0), [len(shared.x)])
        columns = [np.hstack(pair) for pair in zip(shared.columns, own, strict=True)]
        whole, alone = (
            LeastSquares(of, shared.after, shared.sigma, np.append(shared.precision, spread**-2))
            for of in (columns, own)
        )
        gains.append(float(alone.slope[0]) ** 2 * float(np.linalg.inv(whole.normal)[-1, -1]))
    best = joints[int(np.argmax(gains))]
    wanted = (*shared.unknowns, module_unknown(answers.scenario, best, spread))
    fitted = solve(answers, wanted, start=np.append(shared.x, 0.0), on_iteration=on_iteration)
    z = abs(float(fitted.x[-1])) / math.sqrt(float(fitted.covariance[-1, -1]))
    p = min(1.0, len(joints) * math.erfc(z / math.sqrt(2.0)))
    return Search(best, p, len(joints)), fitted


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
class Fitted:
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
class Calibration:
    """What came of a fit.

    Attributes:
        world: Scenario that it started from.
        scenario: That scenario with the fitted values.
        ridges: Directions that the session leaves open.
        search: What came of the search for a module, if there was one.
        lack: Whether the twin fits at all.
        memory: Autocorrelation time of what is left, in samples; 1 is white noise.
        iterations: Of the last fit.
        converged: Whether it came to an end.
        speed: Simulated seconds a second.
    """

    session: str
    world: str
    scenario: Scenario
    parameters: tuple[Fitted, ...]
    ridges: tuple[CorrelatedParameters, ...]
    would_tell: tuple[str, ...]
    before: dict[str, Misfit]
    after: dict[str, Misfit]
    search: Search | None
    lack: LackOfFit
    memory: float
    iterations: int
    converged: bool
    runs: int
    speed: float


def calibrate(
    path: Path,
    world: str | None = None,
    wanted: Wanted | None = None,
    *,
    topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC),
    kernels: Kernels = Kernels.NUMPY,
    on_tick: Callable[[], None] = lambda: None,
    on_iteration: Callable[[int, float, float], None] = lambda _k, _rms, _speed: None,
) -> Calibration:
    """Fit the twin to a session.

    Args:
        path: The session: commands and joint states.
        world: Scenario to start from, by name or file; the one it was recorded in if None.
        wanted: What is to be fitted.
        topics: Of commands and responses.
        kernels: What computes the force laws.
        on_tick: Called at every tick of every run; may raise to end the fit.
        on_iteration: Called with each iteration, the residuals' RMS [rad] and the real-time factor.

    Raises:
        UsageError: If no world is known, or what is wanted isn't there.
        DataError: If the session has too little to fit.
        SimulationError: If the twin fails with the starting values.
        LogError: If the session can't be read.
    """
    wish = wanted or Wanted()
    repetition = find_repetition(path, world, topics=topics)
    driven, scenario = repetition.driven, repetition.scenario
    open_ones = unknowns(scenario, spread=wish.spread, only=wish.only, delay=wish.delay)
    if wish.module is not None:
        open_ones = (*open_ones, module_unknown(scenario, wish.module, wish.spread))
    settle_s = scenario.settle_s if wish.settle_s is None else wish.settle_s
    with Session.open(path) as opened:
        session = opened.with_joints(*topics)
        measured = read_measured(session, settle_s, scenario.duration_s)
        omega = _omega(session)
    if strange := [name for name in measured.joints if name not in scenario.robot.joint_names]:
        raise DataError(f"{path}: {scenario.robot.name} has no joint {', '.join(strange)}")
    count = sum(map(len, measured.angles))
    if count <= 2 * len(open_ones):
        raise DataError(
            f"{path}: {count} settled samples are too few for {len(open_ones)} unknowns"
        )
    gait = partial(driven.make, scenario.robot, scenario)
    answers = Answers(scenario, gait, measured, kernels, on_tick)

    def report_iteration(k: int, rms: float) -> None:
        on_iteration(k, rms, answers.speed)

    first = solution = solve(answers, open_ones, on_iteration=report_iteration)
    search = None
    if wish.search:
        search, with_module = find_weak_module(answers, first, wish.spread, report_iteration)
        solution = with_module if search.named else first
    lack = lack_of_fit(
        measured,
        solution.after,
        omega,
        halves(solution.columns, solution.after, solution.x, solution.precision),
        alternatives(answers, solution),
    )
    return _calibration(
        path, answers, first, solution, search=search, lack=lack, within=wish.within
    )


def _omega(session: SessionView) -> float | None:
    """Angular frequency of the commands [rad/s], or None where they are no steady gait."""
    try:
        gait = measure_session(session, with_dead_bands=False, with_body=False).gait
    except UndulogError:  # a session without a gait can be fitted, too
        return None
    return None if gait is None or not gait.driven else gait.fit.omega


def _calibration(
    path: Path,
    answers: Answers,
    first: Solution,
    solution: Solution,
    *,
    search: Search | None,
    lack: LackOfFit,
    within: float,
) -> Calibration:
    rows = np.column_stack([solution.x, *_ends(solution, lack.alternatives)]).tolist()
    parameters = [
        _fitted(one, x, (low, high), within, fits=not lack.found)
        for one, (x, low, high) in zip(solution.unknowns, rows, strict=True)
    ]
    return Calibration(
        session=str(path),
        world=answers.scenario.name,
        scenario=with_values(answers.scenario, solution.unknowns, solution.x),
        parameters=tuple(parameters),
        ridges=ridges(solution.unknowns, solution.covariance),
        would_tell=suggested_recordings(
            solution.unknowns,
            [i for i, one in enumerate(parameters) if not (one.determined or lack.found)],
        ),
        before=_misfits(answers, first.before),
        after=_misfits(answers, solution.after),
        search=search,
        lack=lack,
        memory=solution.memory,
        iterations=solution.iterations,
        converged=solution.converged,
        runs=answers.runs,
        speed=answers.speed,
    )


def _ends(solution: Solution, others: Sequence[Alternative]) -> tuple[FloatArray, FloatArray]:
    """Ends of the 95 % intervals of x: of this law, and of those that could be the ground's."""
    half = half_widths(solution.covariance)
    low, high = solution.x - half, solution.x + half
    for one in others:
        if one.widens:
            wide, there = half_widths(one.covariance), solution.x + one.shift
            low, high = np.minimum(low, there - wide), np.maximum(high, there + wide)
    return low, high


def _fitted(
    one: Unknown, x: float, ends: tuple[float, float], within: float, *, fits: bool
) -> Fitted:
    half = max(x - ends[0], ends[1] - x)
    # A dead time is no share of itself: 5 % of a control period stand for 5 %.
    wide = one.value(half) * 100.0 if one.name == DELAY else float(np.expm1(half))
    return Fitted(
        name=one.name,
        label=one.label,
        unit=one.unit,
        module=one.module,
        start=one.start,
        value=one.value(x),
        ci95=(one.value(ends[0]), one.value(ends[1])) if fits else None,
        determined=fits and wide <= within,
    )


def _misfits(answers: Answers, residuals: Sequence[np.ndarray]) -> dict[str, Misfit]:
    measured = answers.measured
    rows = zip(measured.joints, measured.times_s, measured.angles, residuals, strict=True)
    return {joint: misfit(t, angle, angle - rest) for joint, t, angle, rest in rows}


def _robot_text(calibration: Calibration) -> str:
    """The robot description with the fitted servo.

    Returns:
        TOML: the former description, its comments kept, under a header with the fitted parameters.

    Raises:
        DataError: If the scenario's robot has no description.
    """
    robot = calibration.scenario.robot
    if not robot.toml:
        raise DataError(f"{robot.name} has no description to put a servo into")
    values = cast("dict[str, Any]", tomlkit.parse(robot.toml))
    for joint in cast("list[dict[str, Any]]", values.get("joints", [])):
        joint.pop("servo", None)
    defaults = cast("dict[str, Any]", values.setdefault("defaults", {}))
    servo = cast("dict[str, Any]", defaults.setdefault("servo", {}))
    # Of a joint that keeps to what all share; a module's own factor is taken out again.
    factor = {one.module: one.value for one in calibration.parameters if one.module is not None}
    first = robot.joints[0]
    shared = replace(
        first.servo, stall_torque=first.servo.stall_torque / factor.get(first.name, 1.0)
    )
    for key, value in vars(shared).items():
        if servo.get(key) != value:  # what was not fitted stays as it was written
            servo[key] = value
    head = [f"# {robot.name}, its servo fitted to {plain(Path(calibration.session).name)}."]
    if calibration.lack.found:
        head.append("# The twin does not fit that session: what follows has no interval.")
    for one in calibration.parameters:
        unit = "" if one.unit == "1" else f" {one.unit}"
        known = "" if one.determined else "; not determined by this session"
        within = "" if one.ci95 is None else f", 95 % {one.ci95[0]:.4g} to {one.ci95[1]:.4g}"
        head.append(f"# {one.label}: {one.value:.4g}{unit}{within}{known}")
    text = "\n".join([*head, "", tomlkit.dumps(values)])
    parse_robot(text, "fitted robot", dict(robot.databases))  # it can be read back
    return text


def _scenario_text(calibration: Calibration, robot_file: Path, scenario_file: Path) -> str:
    """The scenario in which the session can be run again.

    Args:
        robot_file: Where the robot description is.
        scenario_file: Where the scenario will be.
    """
    scenario = calibration.scenario
    modules = {one.module for one in calibration.parameters}
    fitted = [joint for joint in scenario.robot.joints if joint.name in modules]
    own = {joint.name: {"stall_torque": joint.servo.stall_torque} for joint in fitted}
    return replace(
        scenario,
        robot_name=os.path.relpath(robot_file, scenario_file.parent),
        modules=Modules({}, own, scenario.modules.link_of),
    ).toml()


def write_calibration(
    calibration: Calibration, robot_file: Path, scenario_file: Path | None
) -> None:
    """Write the robot, and what its description lists, and the scenario if it is wanted.

    Args:
        scenario_file: The scenario, or None.

    Raises:
        DataError: If the robot has no description.
        LogWriteError: If a file can't be written.
    """
    texts = {robot_file: _robot_text(calibration)}
    if scenario_file is not None:
        texts[scenario_file] = _scenario_text(calibration, robot_file, scenario_file)
    for path, text in texts.items():
        write_text(path, text)
    _write_listed(calibration.scenario.robot, robot_file.parent)


def _write_listed(robot: Robot, folder: Path) -> None:
    """The DBC files and meshes that a description lists lie beside it; those there are left."""
    databases = {name: text.encode() for name, text in robot.databases}
    for name, content in (databases | dict(robot.meshes)).items():
        path = folder / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with part_file(path) as part:
                part.write_bytes(content)
