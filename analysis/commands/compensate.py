"""Command ``plan compensate``: from kicks to commands that make the response homogeneous."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.commands.sessions import CONTRACT, JointTopicOptions

from .plan import Planned, check_numbers, write_sessions
from .predict import coupling_of_result

if TYPE_CHECKING:
    from undulog.capture import SessionView

    from ..plan.compensate import Compensation
    from ..plan.gait_base import BaseGait
    from ..session.runs import GaitRun


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
    check_numbers(runs, settle, measure)
    coupling = coupling_of_result(kicks)
    driven = _runs(after or (), start, topics)

    def design(base: BaseGait, session: SessionView) -> Planned:
        from dataclasses import asdict

        from ..plan.compensate import compensation
        from ..plan.designs import PlannedRun

        found, amplitude = compensation(
            coupling, base, session.robot, driven, target_gain=gain, keep=keep
        )
        run = PlannedRun("compensated", amplitude, {"kind": "compensated"})
        notes = _notes(found, coupling.base.frequency_hz if coupling.base else math.nan, base)
        return Planned((run,) * runs, settle, measure, notes=notes, result=asdict(found))

    write_sessions("compensate", like, output, design, topics, as_json=json)


def _runs(
    files: Sequence[Path], start: float | None, topics: JointTopicOptions
) -> tuple[GaitRun, ...]:
    """Fit the gaits of the sessions."""
    from undulog.capture import Session

    from ..session.analyse import measure_session
    from ..session.runs import gait_run
    from .analyse import chosen

    options = chosen(start, None, topics)
    found: list[GaitRun] = []
    for file in files:
        with Session.open(file) as session:
            fitted = measure_session(session, options, with_dead_bands=False)
            found.append(gait_run(file.name, session.robot, fitted.analysis, fitted.gait))
    return tuple(found)


def _notes(found: Compensation, kicked_hz: float, base: BaseGait) -> tuple[str, ...]:
    """Say what the commands do, and where they can't."""
    before, now = found.kicked, found.now
    left, again = found.prediction_error, found.now != found.kicked
    gain = (before.gain_cv.value, now.gain_cv.value, found.predicted_gain_cv)
    lag = (before.lag_sd.value, now.lag_sd.value, found.predicted_lag_sd)
    notes = [
        f"{what}: {first} without compensation, {f'{last} by the last, ' if again else ''}{then} "
        "predicted"
        for what, (first, last, then) in (
            ("Gain CV", map(_percent, gain)),
            ("Lag spread", map(_degrees, lag)),
        )
    ]
    notes.append(
        f"The kicks identify {found.identified:.1f} of {found.directions} directions; their errors "
        f"leave open {_percent(left)} or {_degrees(left)} a joint"
    )
    if found.largest_step > 0.999 * found.step_limit:
        notes.append(
            f"The step ends at {found.step_limit:.2g} rad or log amplitude, as far as the kicks "
            "hold: drive it, and repeat with --after"
        )
    notes += [
        f"{one.name} is at its {one.limited_by} limit: homogeneity would need "
        f"{_percent(math.expm1(one.lacking))} more amplitude"
        for one in found.joints
        if one.lacking > 0
    ]
    known = [one for one in found.joints if one.margin is not None]
    if known:
        least = min(known, key=lambda one: one.margin or 0.0)
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
