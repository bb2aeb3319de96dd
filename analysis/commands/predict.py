"""Commands on kicks around one gait: ``predict``, and ``plan compensate``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import emit_json
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.common.files import check_output

from .analyse import chosen, experiment_of, show

if TYPE_CHECKING:
    from undulog.capture import SessionView

    from ..plan.compensate import Compensation
    from ..plan.runs import BaseGait
    from ..results.coupling import Coupling, LocalCoupling
    from ..session.runs import GaitRun
    from .plan import Planned


def predict(
    *files: Path,
    eps: float,
    age: float = 0.0,
    kick: Annotated[list[str] | None, Parameter(name="--kick")] = None,
    until: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Predict from kicks how oscillators that feel their servos synchronise through the body.

    Generators phi' = omega + eps (2 q/A cos phi - b), each with its own servo's angle q, have no
    other coupling than the body. The matrices P and R that kicks of the open loop gave
    (`undulog plan phase-kicks`) give how their phases relax or grow, with nothing fitted: rates and
    patterns with 95 % intervals, and what is left of a kick.

    Example: `undulog predict kicks.json --eps 0.3 --kick joint05=0.2 -o predicted.json`

    Args:
        files: The runs of a kick experiment (MCAP), or its result, one `.json` file.
        eps: Rate of the feedback [1/s].
        age: How old a servo's angle is on average when it is used [s].
        kick: `JOINT=RAD`, turn its oscillator and follow all phases; may be given several times.
        until: How long to follow them [s].
        start: Start of what is analysed of each session, from its start [s]; chosen if not given.
        stop: Its end [s].
        topics: Where commands and responses are.
        output: Write the JSON to this file too, a name that ends in .json.
        force: Replace the output file if it exists.
        json: Print the result as one JSON object.
    """
    if not files:
        raise UsageError("predict needs kicks, e.g. undulog predict kicks.json --eps 0.3")
    turned = _kicks(kick or ())
    options = chosen(start, stop, topics)
    if output is not None:
        why = "the prediction is JSON; end its name in .json"
        check_output(output, (".json",), why, force=force)
    from dataclasses import asdict
    from json import dumps

    from undulog.capture.common.files import write_text

    from ..experiment.kick_prediction import closed_loop
    from ..present.text import render_loop

    first, *others = files
    if any(file.suffix.lower() == ".json" for file in files):
        if others:
            raise UsageError("predict takes one result file, or the sessions of an experiment")
        coupling = coupling_of_result(first)
    else:
        coupling = _local(experiment_of(files, options, "predict").coupling)
    loop = closed_loop(coupling, eps, age_s=age, kick=turned, until_s=until)
    if output is not None:
        write_text(output, dumps(asdict(loop), indent=2, allow_nan=False) + "\n")
    if json:
        emit_json(asdict(loop))
        return
    show(lambda width, color: render_loop(loop, width=width, color=color), output)


def _kicks(words: Sequence[str]) -> dict[str, float]:
    """Parse joints and angles of ``JOINT=RAD``."""
    kicks: dict[str, float] = {}
    for word in words:
        name, equals, angle = word.rpartition("=")
        try:
            kicks[name] = float(angle)
        except ValueError:
            equals = ""
        if not name or not equals:
            raise UsageError(f"--kick {word}: expected JOINT=RAD, e.g. joint05=0.2")
    return kicks


def coupling_of_result(file: Path) -> LocalCoupling:
    """Read the coupling of a result of kicks.

    Raises:
        DataError: If the file holds none.
    """
    from ..present.result_files import load
    from ..results.coupling import Coupling
    from ..results.experiment import Experiment

    result = load(file)
    coupling = result.coupling if isinstance(result, Experiment) else result
    if not isinstance(coupling, Coupling):
        raise DataError(
            f"{file}: holds no coupling from kicks; give the result of all their sessions"
        )
    return _local(coupling)


def _local(coupling: Coupling) -> LocalCoupling:
    from ..results.coupling import LocalCoupling

    if isinstance(coupling, LocalCoupling):
        return coupling
    if not coupling.identifiable:
        record = f"; record {coupling.record}" if coupling.record else ""
        raise DataError(f"no coupling to predict from: {coupling.why}{record}")
    raise DataError("no coupling to predict from: these are no kicks around one gait")


def compensate(
    kicks: Path,
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    after: list[Path] | None = None,
    start: float | None = None,
    gain: float | None = None,
    keep: float = 0.15,
    runs: int = 1,
    settle: float = 10.0,
    measure: float = 10.0,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> None:
    """Write commands that make all joints respond alike, from kicks around the gait.

    Phase and amplitude of each joint's command are changed by one Newton step of the matrices that
    the kicks gave, as far as these are known, and within the limits of the servos. Drive the
    session, then give its recording with `--after`: the step is repeated from what was measured.
    Gains and lags count against the wanted wave, that of `--like`, not against the commands.

    Example: `undulog plan compensate kicks.json --like like.mcap -o compensated`

    Args:
        kicks: Result of the kicks, with those of amplitude: `undulog analyse kicks/*.mcap -o`.
        like: A session of the gait that was kicked, or of one near it.
        output: Folder for the sessions.
        after: A recording of the last compensation; of several runs the mean is taken.
        start: Start of what is analysed of each of them, from its start [s]; chosen if not given.
        gain: Gain that all joints are to have; the kicks' mean if not given.
        keep: Price of a change of the commands against the spread of the responses; 0 makes them
            alike at any expense of energy.
        runs: How often the commands are run.
        settle: Time before what is measured [s].
        measure: Length of what is measured [s].
        topics: Where commands and responses of the sessions are.
        json: Print one JSON object.
    """
    from .plan import Planned, check_numbers, write_sessions

    check_numbers(runs, settle, measure)
    coupling = coupling_of_result(kicks)
    driven = _runs(after or (), start, topics)

    def design(base: BaseGait, session: SessionView) -> Planned:
        from dataclasses import asdict

        from ..plan.compensate import compensation
        from ..plan.runs import PlannedRun

        result, amplitude = compensation(
            coupling, base, session.robot, driven, target_gain=gain, keep=keep
        )
        run = PlannedRun("compensated", amplitude, {"kind": "compensated"})
        notes = _notes(result, coupling.base.frequency_hz if coupling.base else math.nan, base)
        return Planned((run,) * runs, settle, measure, notes=notes, result=asdict(result))

    write_sessions("compensate", like, output, design, topics, as_json=json)


def _runs(
    files: Sequence[Path], start: float | None, topics: JointTopicOptions
) -> tuple[GaitRun, ...]:
    """Fit the gaits of the sessions."""
    from undulog.capture import Session

    from ..session.analyse import measure_session
    from ..session.parts import BEYOND_THE_GAIT
    from ..session.runs import gait_run
    from .analyse import chosen

    options = chosen(start, None, topics)
    runs: list[GaitRun] = []
    for file in files:
        with Session.open(file) as session:
            fitted = measure_session(session, options, without=BEYOND_THE_GAIT)
            runs.append(gait_run(file.name, session.robot, fitted.analysis, fitted.gait))
    return tuple(runs)


def _notes(compensation: Compensation, kicked_hz: float, base: BaseGait) -> tuple[str, ...]:
    """Say what the commands do, and where they can't."""
    before, now = compensation.kicked, compensation.now
    left, again = compensation.prediction_error, compensation.now != compensation.kicked
    gain = (before.gain_cv.value, now.gain_cv.value, compensation.predicted_gain_cv)
    lag = (before.lag_sd.value, now.lag_sd.value, compensation.predicted_lag_sd)
    notes = [
        f"{what}: {first} without compensation, {f'{last} by the last, ' if again else ''}{then} "
        "predicted"
        for what, (first, last, then) in (
            ("Gain CV", map(_percent, gain)),
            ("Lag spread", map(_degrees, lag)),
        )
    ]
    notes.append(
        f"The kicks identify {compensation.identified:.1f} of {compensation.directions} "
        f"directions; their errors leave open {_percent(left)} or {_degrees(left)} a joint"
    )
    if compensation.largest_step > 0.999 * compensation.step_limit:
        notes.append(
            f"The step ends at {compensation.step_limit:.2g} rad or log amplitude, as far as the "
            "kicks hold: drive it, and repeat with --after"
        )
    notes += [
        f"{joint.name} is at its {joint.limited_by} limit: homogeneity would need "
        f"{_percent(math.expm1(joint.lacking))} more amplitude"
        for joint in compensation.joints
        if joint.lacking > 0
    ]
    limited = [joint for joint in compensation.joints if joint.margin is not None]
    if limited:
        least = min(limited, key=lambda joint: joint.margin or 0.0)
        notes.append(
            f"The least margin is that of {least.name}: {_percent(least.margin)} of its "
            f"{least.limited_by} limit is left"
        )
    hz = base.omega / (2 * math.pi)
    if not abs(hz / kicked_hz - 1) < 0.005:
        notes.append(
            f"Warning: the kicks are around {kicked_hz:.3g} Hz, this gait has {hz:.3g} Hz: near by "
            "they may hold, and --after shows whether they do"
        )
    return tuple(notes)


def _percent(share: float | None) -> str:
    return "unknown" if share is None else f"{100 * share:.2g} %"


def _degrees(angle: float | None) -> str:
    return "unknown" if angle is None else f"{math.degrees(angle):.2g}°"
