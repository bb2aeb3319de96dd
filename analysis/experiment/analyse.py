"""Several sessions of one experiment in, one answer out."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import UsageError
from undulog.capture.common.extras import base_versions
from undulog.capture.robot.model import Robot

from ..common.estimate import Provenance
from ..estimators.intervals import CONFIDENCE, EQUIVALENT_GAIN, EQUIVALENT_LAG_RAD
from ..oscillators.predictions import body_oscillators
from ..parts.body.connection import MIN_GAITS
from ..parts.body.connection import MOST_CONDITION as MOST_SHAPE_CONDITION
from ..response.fitting import GaitFit
from ..response.response import gain_estimate, lag_estimate
from ..results.analysis import Analysis
from ..results.body_connection import BodyConnection
from ..results.coupling import Coupling, LocalCoupling
from ..results.experiment import Experiment, Headings, PooledJoint, PooledRuns, Reversal, Run
from ..session.analyse import measure_session
from ..session.runs import (
    SAME_COMMAND,
    SAME_FREQUENCY,
    GaitRun,
    Role,
    coupling_of_one_gait,
    gait_run,
    mirror_fault,
    posture,
    responses,
    sort_runs,
)
from ..signals.stretch import Options
from .answer import broken_first, experiment_answer, kick_answer, sweep_answer
from .best_linear import best_linear_responses, multisine_answer
from .body_connection import MOST_DISTANCE, GaitSession, body_connection, connection_answer
from .kick_coupling import kick_coupling
from .kick_runs import MOST_KICK, MOST_PATTERN, SAME, find_kicks
from .local_coupling import ROW_TOLERANCE
from .mirror import MIN_RUNS, MOST_LABELLINGS, RANDOM_LABELLINGS
from .multisine_runs import MultisineRun, MultisineRuns, find_multisine, multisine_run
from .pooling import PooledResponse, experiment_indices, pool_runs, pooled_answer
from .reversal import RESAMPLES, SAME_HEADING_RAD, SIGNIFICANT, floor_lean, reversal_of
from .sweep_coupling import NONLINEAR, sweep_coupling
from .sweep_runs import MOST_CONDITION, CommandTones, Sweep, command_tones, find_sweep

_LOW_FLOOR = 0.01
"""A p-value that can't go below this leaves little room under the level."""


def analyse_experiment(
    sessions: Iterable[SessionView], options: Options | None = None
) -> Experiment:
    """Analyse several sessions as one experiment.

    Args:
        sessions: Open sessions, each used once and in turn, so they may be opened one by one.
        options: What the user chose, for each of them.

    Returns:
        The result. What can't be computed is None, and a warning says why.

    Raises:
        MissingChannelError: If a session has neither commands nor responses.
        DataError: If they hold no samples.
        UsageError: If there is no session, or the options leave nothing of one.
    """
    examined = _examine(sessions, options or Options())
    analyses, runs, warn = examined.analyses, examined.runs, examined.warn
    multisine = find_multisine(examined.periodic)
    if multisine is not None:
        return _of_multisine(multisine, examined)
    kicks = find_kicks(runs)
    sweep = find_sweep(examined.commanded) if kicks is None else None
    if sweep is not None:
        return _of_sweep(sweep, examined)
    body = None
    if kicks is None:
        body, apart = body_connection(examined.cycles)
        if body is not None and body.fitted and len(sort_runs(runs)[0]) < MIN_GAITS:
            return _of_perturbed(body, apart, examined)
    parts = [None if kicks is None else kicks.role(k) for k in range(len(runs))]
    rest = [k for k, part in enumerate(parts) if part in (None, "base")]
    own_roles, own_why = sort_runs([runs[k] for k in rest])
    roles = {rest[k]: role for k, role in own_roles.items()}
    why = {rest[k]: reason for k, reason in own_why.items()}
    # Kicks around one gait identify its coupling; the reversal is tested if both ways are there.
    only_kicks = kicks is not None and len(set(roles.values())) < 2
    if only_kicks:
        why = {k: reason for k, reason in why.items() if parts[k] is None}
    parts_of = {k: part for k, part in enumerate(parts) if part is not None}
    parts_of |= {} if only_kicks else {k: role.value for k, role in roles.items()}
    examined.leave_out(why, " of the reversal test")
    chosen = [runs[k] for k in roles]
    names, y = responses(chosen) if chosen else ((), np.zeros((0, 0), dtype=np.complex128))
    ways = list(roles.values())
    forward, reverse = (y[[way is role for way in ways]] for role in (Role.FORWARD, Role.REVERSE))
    pooled = (
        pool_runs(chosen[0].names, [run.response for run in chosen])
        if len(set(ways)) == 1
        else None
    )
    robot = examined.robots[next(iter(roles))] if roles else None
    joints = None
    if pooled is not None:
        used = [analyses[k] for k in roles]
        joints = used[0].answer if len(used) == 1 else pooled_answer(robot, pooled, used)
    reversal = None
    if not only_kicks and _both_ways(chosen, ways, names, robot, warn):
        reversal = _reversal(names, (forward, reverse), chosen, ways)
        _warn_floor(reversal, warn)
        _warn_headings(reversal, warn)
    coupling = coupling_of_one_gait(len(names)) if kicks is None else kick_coupling(kicks, warn)
    answer = (
        kick_answer(coupling) if only_kicks else experiment_answer(reversal, roles, pooled, joints)
    )
    return _experiment(
        examined,
        parts_of,
        why,
        # The answer on the runs of one direction has these joints in it.
        answer if joints is not None else broken_first(analyses, answer),
        coupling,
        heterogeneity=experiment_indices(forward, reverse, reversal),
        reversal=reversal,
        oscillators=body_oscillators(coupling) if isinstance(coupling, LocalCoupling) else None,
        pooled=None if pooled is None else _pooled(pooled),
        body_connection=body,
    )


@dataclass(frozen=True)
class _Examined:
    """Sessions one by one, each list in their order, and the warnings on all of them."""

    options: Options
    warnings: list[str] = field(default_factory=list[str])
    analyses: list[Analysis] = field(default_factory=list[Analysis])
    runs: list[GaitRun] = field(default_factory=list[GaitRun])
    gaits: list[GaitFit | None] = field(default_factory=list[GaitFit | None])
    robots: list[Robot | None] = field(default_factory=list[Robot | None])
    commanded: list[CommandTones | None] = field(default_factory=list[CommandTones | None])
    cycles: list[GaitSession | None] = field(default_factory=list[GaitSession | None])
    periodic: list[MultisineRun | str | None] = field(
        default_factory=list[MultisineRun | str | None]
    )

    def warn(self, sentence: str) -> None:
        """Add a warning."""
        self.warnings.append(sentence)

    def leave_out(self, why: Mapping[int, str], of: str = "") -> None:
        """Warn of sessions that are left out, by index."""
        for k, text in why.items():
            self.warn(f"{self.runs[k].label} {text}; it is left out{of}")


def _examine(sessions: Iterable[SessionView], options: Options) -> _Examined:
    """Analyse each session.

    Raises:
        UsageError: If there is none.
    """
    examined = _Examined(options)
    for session in sessions:
        measured = measure_session(session, options)
        analysis, gait, robot = measured.analysis, measured.gait, session.robot
        cycle = measured.cycle
        del measured  # heavy: no two at a time
        label, lay = Path(analysis.session.path).name, posture(session, analysis.gait.windows)
        name = analysis.session.robot
        examined.runs.append(gait_run(label, robot, analysis, gait, lay))
        examined.analyses.append(analysis)
        examined.gaits.append(gait)
        examined.cycles.append(None if cycle is None else GaitSession(analysis.session.path, cycle))
        examined.robots.append(robot)
        examined.commanded.append(command_tones(session, options, gait, name))
        examined.periodic.append(multisine_run(session, options, name) if gait is None else None)
    if not examined.runs:
        raise UsageError("an experiment needs at least one session")
    return examined


def _experiment(
    examined: _Examined,
    roles: Mapping[int, str],
    why: Mapping[int, str],
    answer: str,
    coupling: Coupling,
    **more: Any,
) -> Experiment:
    """Return the result.

    Args:
        roles: Of the sessions that have a part in the experiment, by index.
        why: Why the others have none.
        **more: Its other fields.
    """
    none = np.zeros((0, 0), dtype=np.complex128)
    reasons = {k: text for k, text in why.items() if k not in roles}
    fields: dict[str, Any] = {
        "heterogeneity": experiment_indices(none, none, None),
        "reversal": None,
        "sessions": tuple(examined.analyses),
        "runs": tuple(
            Run(analysis.session.id, analysis.session.path, run.wave, roles.get(k), reasons.get(k))
            for k, (analysis, run) in enumerate(zip(examined.analyses, examined.runs, strict=True))
        ),
        "warnings": tuple(examined.warnings),
        "provenance": _provenance(examined.analyses, examined.options),
    }
    return Experiment(answer=answer, coupling=coupling, **fields | more)


def _of_sweep(sweep: Sweep, examined: _Examined) -> Experiment:
    """Return the experiment of a lag sweep or a multisine: its gaits are not repeats."""
    analyses, others = examined.analyses, set(range(len(examined.runs))).difference(sweep.index)
    for k in sorted(others):
        examined.warn(f"{examined.runs[k].label} is no run of the sweep; it is left out")
    paths = [Path(analysis.session.path) for analysis in analyses]
    coupling = sweep_coupling(sweep, examined.commanded, paths, examined.options, examined.warn)
    answer = broken_first(analyses, sweep_answer(coupling))
    roles, why = dict.fromkeys(sweep.index, "sweep"), dict.fromkeys(others, "is no run of it")
    return _experiment(examined, roles, why, answer, coupling)


def _of_perturbed(
    body: BodyConnection, apart: Mapping[int, str], examined: _Examined
) -> Experiment:
    """Return the experiment of gaits around one gait, each other than the rest."""
    examined.leave_out(apart)
    answered = [len(gait.all_answered) for gait in examined.gaits if gait is not None]
    coupling = replace(
        coupling_of_one_gait(min(answered, default=0)),
        why="gaits perturbed as a whole do not tell the effect of one joint's command from that of "
        "the others",
    )
    roles = {k: "perturbed" for k in range(len(examined.runs)) if k not in apart}
    answer = broken_first(examined.analyses, connection_answer(body))
    return _experiment(examined, roles, apart, answer, coupling, body_connection=body)


def _of_multisine(multisine: MultisineRuns, examined: _Examined) -> Experiment:
    """Return the experiment of random-phase multisines over a band."""
    examined.leave_out(multisine.why)
    best_linear = best_linear_responses(multisine.runs, examined.warn)
    roles = dict.fromkeys(multisine.index, "multisine")
    answer = broken_first(examined.analyses, multisine_answer(best_linear))
    coupling = coupling_of_one_gait(0)
    return _experiment(examined, roles, multisine.why, answer, coupling, best_linear=best_linear)


def _reversal(
    names: Sequence[str],
    y: tuple[ComplexArray, ComplexArray],
    runs: Sequence[GaitRun],
    ways: Sequence[Role],
) -> Reversal:
    """Test the runs by reversal, with their headings and recorded gravity."""
    heading = np.array([run.posture.heading_rad for run in runs])
    lean = np.array([run.posture.lean_rad for run in runs])
    forward = np.array([way is Role.FORWARD for way in ways])
    return reversal_of(names, *y, (heading[forward], heading[~forward]), floor_lean(lean, heading))


def _pooled(pooled: PooledResponse) -> PooledRuns:
    joints = [
        PooledJoint(name, gain_estimate(pooled.response, k), lag_estimate(pooled.response, k))
        for k, name in enumerate(pooled.names)
    ]
    return PooledRuns(pooled.runs, tuple(joints))


def _both_ways(
    runs: Sequence[GaitRun],
    ways: Sequence[Role],
    names: Sequence[str],
    robot: Robot | None,
    warn: Warn,
) -> bool:
    """Return whether the reversal test can be made; warn why not, and of its assumptions."""
    counts = {role: sum(way is role for way in ways) for role in Role}
    if not any(counts.values()):
        warn("no run with a travelling wave: the reversal test can't be made")
        return False
    forward = counts[Role.FORWARD]
    if min(counts.values()) < MIN_RUNS:
        warn(
            f"boundary or module: not separable from {forward} independent "
            f"run{'' if forward == 1 else 's'} with "
            f"the wave from head to tail and {counts[Role.REVERSE]} from tail to head; record at "
            "least 6 of each"
        )
        return False
    fault = mirror_fault(robot, runs[0].names)
    if fault is not None:
        warn(f"the robot is not its own mirror image, so a profile need not mirror: {fault}")
        return False
    if len(names) < 2:
        warn("fewer than two joints have gain and lag in every run: nothing can be mirrored")
        return False
    if len(names) < len(runs[0].names):
        lost = [name for name in runs[0].names if name not in names]
        warn(f"without gain and lag at it or its mirror joint in every run: {', '.join(lost)}")
    if robot is None:
        warn("no robot description: the log's order of joints is taken as a chain, head to tail")
    both = list(zip(runs, ways, strict=True))
    starts = [[run.start_ns for run, way in both if way is role] for role in Role]
    first, second = sorted(starts, key=min)
    if max(first) < min(second):
        warn(
            "all runs one way come before all runs the other way: warming up looks like a "
            "difference of direction; let them alternate"
        )
    return True


def _warn_floor(reversal: Reversal, warn: Warn) -> None:
    if reversal.p_floor <= _LOW_FLOOR:
        return
    never = ", so no difference can be shown" if reversal.p_floor >= SIGNIFICANT else ""
    warn(
        f"p can't go below {reversal.p_floor:.2g} with {reversal.forward_runs} + "
        f"{reversal.reverse_runs} runs{never}; record at least 6 of each"
    )


def _warn_headings(reversal: Reversal, warn: Warn) -> None:
    """Warn where a tilted floor isn't cancelled and could change what is named."""
    if reversal.p >= SIGNIFICANT or reversal.tilt.headings is Headings.BALANCED:
        return
    recorded = reversal.tilt.headings is not Headings.UNKNOWN
    why = "headings are not balanced" if recorded else "heading is not recorded"
    warn(
        f"the robot's {why}, so a tilted floor doesn't cancel; turn the robot by half a turn "
        "in half of the runs of each direction (undulog plan reversal)"
    )


def _provenance(analyses: Sequence[Analysis], options: Options) -> Provenance:
    paths = [analysis.session.path for analysis in analyses]
    named = zip(paths, analyses, strict=True)
    return Provenance(
        command=shlex.join(["undulog", "analyse", *paths, *options.arguments()]),
        versions=base_versions(),
        inputs={path: analysis.provenance.inputs[path] for path, analysis in named},
        options={
            **asdict(options),
            "confidence": CONFIDENCE,
            "level": SIGNIFICANT,
            "same_command": SAME_COMMAND,
            "same_frequency": SAME_FREQUENCY,
            "same_heading_rad": SAME_HEADING_RAD,
            "most_labellings": MOST_LABELLINGS,
            "random_labellings": RANDOM_LABELLINGS,
            "bootstrap_resamples": RESAMPLES,
            "same_kick": SAME,
            "most_kick": MOST_KICK,
            "most_pattern": MOST_PATTERN,
            "row_tolerance": ROW_TOLERANCE,
            "most_condition": MOST_CONDITION,
            "nonlinear": NONLINEAR,
            "least_gaits": MIN_GAITS,
            "most_gait_distance": MOST_DISTANCE,
            "most_shape_condition": MOST_SHAPE_CONDITION,
            "margin_gain": EQUIVALENT_GAIN,
            "margin_lag_rad": EQUIVALENT_LAG_RAD,
        },
    )
