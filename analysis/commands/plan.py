"""Commands ``plan ...``: from a recorded gait to the sessions of commands of an experiment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import echo, emit_json
from undulog.capture.common.errors import UsageError

if TYPE_CHECKING:
    from undulog.capture import SessionView

    from ..plan.runs import BaseGait, PlannedRun


LEAST, MOST = 0.01, 0.12
"""Kicks that the analysis accepts; others are reported as too small or large."""

AMPLITUDE = 0.02
_LEAST_SETTLE_S = 10.0

_MOST_RUNS = 1000


def phase_kicks(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    runs: int = 1,
    base_runs: int = 6,
    kick: float = 0.05,
    settle: float = 10.0,
    measure: float = 10.0,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> None:
    """Write the commands of kicks around a recorded gait, which identify its coupling.

    Six runs of the gait itself, which show how much runs differ, four of each driven joint (phase
    +0.05 and -0.05 rad, amplitude +5 and -5 %), three held-out random patterns. Drive each with
    `undulog drive`, then give all recordings to `undulog analyse`.

    Example: `undulog plan phase-kicks --like run.mcap -o kicks`

    Args:
        like: A session of the gait.
        output: Folder for the sessions.
        runs: How often each of them is run; those of the gait as it is are shared out.
        base_runs: Runs of the gait as it is, in all.
        kick: Size of the kicks, of phase [rad] and of log amplitude.
        settle: Time before what is measured [s].
        measure: Length of what is measured [s].
        topics: Where commands and responses of that session are.
        json: Print one JSON object.
    """
    if base_runs < 1 or not LEAST <= kick <= MOST:
        raise UsageError(f"--base-runs is at least 1, --kick {LEAST:g} to {MOST:g}")
    check_numbers(runs, settle, measure)

    def design(base: BaseGait, session: SessionView) -> Planned:
        from ..plan.designs import phase_kicks as kicks

        _check_joints(base, session, "kicks need")
        names = tuple(base.names[k] for k in base.driven)
        planned = kicks(names, base.amplitude, runs, kick=kick, base_runs=base_runs)
        return Planned(planned, settle, measure)

    write_sessions("phase-kicks", like, output, design, topics, as_json=json)


def reversal(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    runs: int = 6,
    settle: float = 10.0,
    measure: float = 10.0,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> None:
    """Write the commands of a recorded gait and of its reverse, to separate boundary from module.

    The robot is turned by 180 degrees in half of the runs of each direction, so that a tilted floor
    cancels. The heading is in each file's name and metadata; the twin starts with it, a robot has
    to be put down so.

    Example: `undulog plan reversal --like run.mcap -o reversal`

    Args:
        like: A session of the gait.
        output: Folder for the sessions.
        runs: Runs each way, an even number so that half of them are turned.
        settle: Time before what is measured [s].
        measure: Length of what is measured [s].
        topics: Where commands and responses of that session are.
        json: Print one JSON object.
    """
    check_numbers(runs, settle, measure)

    def design(base: BaseGait, _: SessionView) -> Planned:
        from ..plan.designs import reversal as both_ways

        note = (
            "Before each file whose name ends in -180, put the robot down turned by 180 degrees; "
            "before the others, as in the first"
        )
        return Planned(both_ways(base.amplitude, runs), settle, measure, notes=(note,))

    write_sessions("reversal", like, output, design, topics, as_json=json)


@dataclass(frozen=True)
class Planned:
    """Runs with their times, facts for their metadata, notes for the user, more for the JSON."""

    runs: tuple[PlannedRun, ...]
    settle_s: float
    measure_s: float
    facts: dict[str, str] = field(default_factory=dict[str, str])
    notes: tuple[str, ...] = ()
    result: dict[str, Any] = field(default_factory=dict[str, Any])


def check_numbers(runs: int, settle_s: float, measure_s: float) -> None:
    """Refuse numbers of runs and times that no plan has."""
    if runs < 1 or settle_s < 0 or measure_s <= 0:
        raise UsageError("--runs is at least 1, --settle at least 0, --measure more than 0")


def _check_joints(base: BaseGait, session: SessionView, need: str) -> None:
    if len(base.driven) < 3:
        raise UsageError(f"{session.path}: it drives {len(base.driven)} joints; {need} at least 3")


def write_sessions(
    plan: str,
    like: Path,
    folder: Path,
    design: Callable[[BaseGait, SessionView], Planned],
    topics: JointTopicOptions,
    *,
    as_json: bool,
    base_of: Callable[[SessionView], BaseGait] | None = None,
) -> None:
    """Write the sessions of a plan and print what to do with them.

    Args:
        base_of: What the commands are around; the gait of ``like`` by default.
    """
    from undulog.capture import Session

    from ..plan.runs import base_gait, write_plan

    with Session.open(like) as opened:
        session = topics.view(opened)
        base = (base_of or base_gait)(session)
        planned = design(base, session)
        settle_s, measure_s = planned.settle_s, planned.measure_s
        times = {"settle_s": settle_s, "measure_s": measure_s}
        files = write_plan(plan, base, planned.runs, session, folder, **times, facts=planned.facts)
    if as_json:
        written = {"plan": plan, "files": [str(file) for file in files], "settle_s": settle_s}
        emit_json(written | planned.result)
        return
    length_s = settle_s + measure_s
    echo(
        f"{folder}: {plan}, {len(files)} runs of {length_s:g} s, "
        f"{len(files) * length_s / 60:.1f} min in all"
    )
    echo(
        "Drive each, in this order, with undulog drive FILE --on ...; then undulog analyse "
        f"--start {settle_s:g} of all recordings"
    )
    echo(*planned.notes)


def lag_sweep(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    amplitude: float = AMPLITUDE,
    runs: int = 1,
    settle: float | None = None,
    measure: float = 10.0,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> None:
    """Write the commands of a lag sweep, which identifies the coupling of a chain without contact.

    As many gaits as joints are driven, of small amplitude and of the lags 2 pi k/m. For a robot
    that touches nothing (hung up, floating, or a twin with surface = "none"): on the ground every
    gait is its own operating point, and phase-kicks are the plan.

    Example: `undulog plan lag-sweep --like run.mcap -o sweep`

    Args:
        like: A session of a gait: its joints, offsets and frequency.
        output: Folder for the sessions.
        amplitude: Of every command [rad].
        runs: How often each of them is run.
        settle: Time before what is measured [s]; 5 time constants of the slowest body mode, at
            least 10 s, if not given.
        measure: Length of what is measured [s].
        topics: Where commands and responses of that session are.
        json: Print one JSON object.
    """
    check_tones(amplitude, runs)

    def design(base: BaseGait, session: SessionView) -> Planned:
        from ..plan.designs import lag_sweep as sweep

        planned = sweep(len(base.driven), amplitude, runs)
        return without_contact(base, session, planned, (amplitude, settle, measure))

    write_sessions("lag-sweep", like, output, design, topics, as_json=json)


def check_tones(amplitude: float, runs: int) -> None:
    """Refuse amplitudes and numbers of runs that no plan has."""
    if amplitude <= 0 or runs < 1:
        raise UsageError("--amplitude is more than 0, --runs at least 1")


def without_contact(
    base: BaseGait,
    session: SessionView,
    runs: tuple[PlannedRun, ...],
    numbers: tuple[float, float | None, float],
) -> Planned:
    """Check the runs of a chain without contact, and find how long it takes to settle."""
    amplitude, settle_s, measure_s = numbers
    _check_joints(base, session, "a sweep needs")
    check_servos(base, runs, session)
    needed_s, facts = settling(base, session)
    settle_s = needed_s if settle_s is None else settle_s
    if settle_s < 0 or measure_s <= 0:
        raise UsageError("--settle is at least 0, --measure more than 0")
    notes: list[str] = []
    if facts:
        notes.append(
            f"The slowest body mode without contact has {facts['mode_hz']} Hz and dies away with "
            f"{facts['mode_tau_s']} s"
        )
    if settle_s < needed_s:
        notes.append(f"Warning: it needs {needed_s:g} s to settle; {settle_s:g} s is less")
    facts = {"amplitude_rad": f"{amplitude:g}", **facts}
    return Planned(runs, settle_s, measure_s, facts, tuple(notes))


def settling(base: BaseGait, session: SessionView) -> tuple[float, dict[str, str]]:
    """Return how long a chain without contact takes to settle.

    Args:
        base: The gait.
        session: Of that robot.

    Returns:
        The time [s], the commands' ramp included, and the slowest mode for the metadata; without
        a robot description the least time, and nothing.
    """
    from ..plan.designs import TIME_CONSTANTS, slowest_mode
    from ..plan.runs import RAMP_S

    robot = session.robot_as_run
    if robot is None:
        return _LEAST_SETTLE_S, {}
    mode = slowest_mode(robot, [base.names[k] for k in base.driven])
    return max(_LEAST_SETTLE_S, RAMP_S + math.ceil(TIME_CONSTANTS * mode.time_constant_s)), {
        "mode_hz": f"{mode.frequency_hz:.4g}",
        "mode_damping": f"{mode.damping:.4g}",
        "mode_tau_s": f"{mode.time_constant_s:.4g}",
    }


def check_servos(base: BaseGait, runs: tuple[PlannedRun, ...], session: SessionView) -> None:
    """Refuse commands that leave the servos' linear range.

    Args:
        base: The gait.
        runs: The runs.
        session: Of that robot; without a description nothing is checked.

    Raises:
        UsageError: If an error as large as the command saturates its servo (duty Kp (q_ref - q)
            beyond 1).
    """
    if session.robot is None:
        return
    import numpy as np

    joints = {joint.name: joint for joint in session.robot.joints}
    tones = runs[0].tones(base.omega)
    size = np.sum([np.abs(tone.amplitude) for tone in tones], axis=0)
    for row, k in enumerate(base.driven):
        joint = joints.get(base.names[k])
        if joint is None:
            continue
        if joint.servo.proportional_gain * size[row] > 1:
            raise UsageError(
                f"the servo of {joint.name} would saturate: its gain times {size[row]:.3g} rad is "
                f"{joint.servo.proportional_gain * size[row]:.2f}, 1 is full duty; lower "
                "--amplitude"
            )


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BandOptions:
    """Random-phase multisines over a band.

    Attributes:
        period: After which the commands repeat [s]; the lines are multiples of its reciprocal.
        periods: Steady periods that are measured, after the settling time.
        realisations: Of the random phases.
        amplitude_is: Whether `--amplitude` is each command's root mean square or the largest peak.
        inputs: `same`: all joints have one command; `orthogonal`: each has its own in as many
            runs a realisation as joints are driven, which identify the response of every joint to
            every command.
        joint: Joints to drive, each named by an option of its own; those that the session drives
            if none is named.
        seed: Of the random numbers.
    """

    period: float = 10.0
    periods: int = 2
    realisations: int = 10
    amplitude_is: Literal["rms", "peak"] = "rms"
    inputs: Literal["same", "orthogonal"] = "same"
    joint: tuple[str, ...] = ()
    seed: int = 1


_DEFAULT = BandOptions()


def multisine(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    amplitude: float = AMPLITUDE,
    tones: int | None = None,
    band: tuple[float, float] | None = None,
    options: BandOptions = _DEFAULT,
    runs: int = 1,
    settle: float | None = None,
    measure: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> None:
    """Write the commands of multisines: many frequencies at once.

    With `--band`: odd random-phase multisines, which give the best linear approximation of each
    joint's response, with noise and nonlinear distortion apart. A period to settle, two that are
    measured, ten realisations of the phases. The joints stay around their offsets in that session.

    Example: `undulog plan multisine --like run.mcap --band 0.1 5 -o band`

    Without: coupling without contact at a few tones. As many runs as joints are driven; in each
    all joints move at all tones, with the phases of a DFT over the runs. The first tone is the
    gait's frequency, and none is another plus a whole number of the gait's, so that what a
    nonlinearity mixes shows beside the tones.

    Example: `undulog plan multisine --like run.mcap -o tones`

    Args:
        like: A session of a gait: its joints, offsets and frequency; with `--band` of any commands.
        output: Folder for the sessions.
        amplitude: Of the first tone of every command [rad]; the others fall with the square of
            the frequency, so that all of them need about the same torque. With `--band` of the
            whole command.
        tones: How many, 3 if not given.
        band: Lowest and highest frequency [Hz].
        runs: How often each of them is run.
        settle: Time before what is measured [s]; 5 time constants of the slowest body mode, at
            least 10 s, if not given; with `--band` one period.
        measure: Length of what is measured [s], rounded up to whole periods; 20 if not given.
        topics: Where commands and responses of that session are.
        json: Print one JSON object.
    """
    check_tones(amplitude, runs)
    if band is not None:
        if tones is not None or measure is not None:
            raise UsageError("--band takes --period and --periods; leave out --tones and --measure")
        numbers = (amplitude, runs, settle)
        _write_band(like, output, band, options, numbers=numbers, topics=topics, as_json=json)
        return
    if options != _DEFAULT:
        given = [
            option.name
            for option in fields(options)
            if getattr(options, option.name) != option.default
        ]
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError(f"{names}: only with --band, the lowest and the highest frequency")
    tones = 3 if tones is None else tones
    if tones < 2:
        raise UsageError("--tones is at least 2; for one frequency there is plan lag-sweep")

    def design(base: BaseGait, session: SessionView) -> Planned:
        from ..plan import designs

        omega = designs.tones(base.omega, tones)
        planned = designs.multisine(len(base.driven), amplitude, omega, runs)
        period = designs.period_s(base.omega, tones)
        whole_s = math.ceil((20.0 if measure is None else measure) / period - 1e-6) * period
        return without_contact(base, session, planned, (amplitude, settle, whole_s))

    write_sessions("multisine", like, output, design, topics, as_json=json)


def _write_band(
    like: Path,
    output: Path,
    band_hz: tuple[float, float],
    options: BandOptions,
    *,
    numbers: tuple[float, int, float | None],
    topics: JointTopicOptions,
    as_json: bool,
) -> None:
    """Write odd random-phase multisines over a band."""
    from ..plan.designs import odd_lines, random_phase_runs

    amplitude, repeats, settle_s = numbers
    if options.periods < 1 or options.realisations < 1 or options.seed < 0:
        raise UsageError("--periods and --realisations are at least 1, --seed at least 0")
    if not math.isfinite(amplitude):
        raise UsageError("--amplitude is a finite number")
    lines = odd_lines(band_hz, options.period, options.seed)
    settle_s = options.period if settle_s is None else settle_s
    if not 0 <= settle_s < math.inf:
        raise UsageError("--settle is at least 0")

    def base_of(session: SessionView) -> BaseGait:
        from ..plan.runs import base_pose

        return base_pose(session, options.joint or None, 2 * math.pi / options.period)

    def design(base: BaseGait, session: SessionView) -> Planned:
        m = len(base.driven)
        count = options.realisations * repeats * (m if options.inputs == "orthogonal" else 1)
        if count > _MOST_RUNS:
            raise UsageError(
                f"{count} runs for {m} joints, at most {_MOST_RUNS}; take fewer --realisations or "
                "name joints by --joint"
            )
        shared, planned = random_phase_runs(
            m,
            lines,
            options.period,
            amplitude,
            of_peak=options.amplitude_is == "peak",
            realisations=options.realisations,
            inputs=options.inputs,
            seed=options.seed,
        )
        facts = {
            "period_s": f"{options.period:.12g}",
            "periods": str(options.periods),
            "lines": " ".join(map(str, shared.lines.tolist())),
            "realisations": str(options.realisations),
            "inputs": options.inputs,
            "rms_rad": f"{shared.rms:.6g}",
            "peak_rad": f"{shared.peak:.6g}",
            "seed": str(options.seed),
        }
        low, high = (line / options.period for line in (shared.lines[0], shared.lines[-1]))
        size = f"{shared.rms:.3g} rad RMS, peak {shared.peak:.3g} rad"
        notes = [f"{shared.lines.size} lines from {low:.4g} to {high:.4g} Hz, {size}"]
        needed_s, mode = settling(base, session)
        if mode and settle_s < needed_s:
            notes.append(
                f"Warning: without contact the slowest body mode needs {needed_s:g} s to settle; "
                f"{settle_s:g} s is less (--settle)"
            )
        if min(options.periods, options.realisations) < 2:
            notes.append(
                "Warning: one period or one realisation: distortion is not separable from noise"
            )
        measure_s = options.periods * options.period
        result = {"lines": shared.lines.tolist(), "period_s": options.period}
        return Planned(planned * repeats, settle_s, measure_s, facts, tuple(notes), result)

    write_sessions("multisine", like, output, design, topics, as_json=as_json, base_of=base_of)
