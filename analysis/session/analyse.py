"""Analyse one session: measure the parts, and put their results together."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Collection
from dataclasses import asdict

from undulog.capture import SessionView
from undulog.capture.common.extras import base_versions

from ..common.answer import led
from ..common.estimate import Provenance
from ..common.remarks import Remarks
from ..estimators.intervals import CONFIDENCE
from ..estimators.spectrum import BINS_PER_SIDE
from ..parts.artefacts.part import ARTEFACTS
from ..parts.body.part import BODY, MeasuredBody
from ..parts.comparison.answer import Facts, compose
from ..parts.comparison.part import COMPARISON
from ..parts.energy.part import ENERGIES, ENERGY
from ..parts.free_motion.part import FREE_MOTION
from ..parts.frequency_response.part import FREQUENCY_RESPONSE
from ..parts.gait.part import GAIT
from ..parts.gaits.measure import gait_windows
from ..parts.gaits.part import GAITS
from ..parts.ground_contact.part import GROUND_CONTACT
from ..parts.heterogeneity.part import HETEROGENEITY
from ..parts.joints.measure import gait_facts
from ..parts.joints.part import JOINTS
from ..parts.judgement.part import JUDGEMENT
from ..parts.oscillators.part import CLOSED_LOOP, OSCILLATORS
from ..parts.over_time.part import OVER_TIME
from ..parts.part import in_order, measure
from ..parts.tracking.part import TRACKING
from ..response.rhythm import HARMONICS, MIN_CYCLES, MIN_EXPLAINED
from ..results.analysis import Analysis, SessionFacts
from ..signals.columns import drag_ratio
from ..signals.session_signals import read_signals
from ..signals.stretch import Options
from .added_parts import added_parts, checked
from .measurement import SessionMeasurement
from .parts import PARTS
from .runs import coupling_of_one_gait


def analyse_session(session: SessionView, options: Options | None = None) -> Analysis:
    """Analyse one session.

    Returns:
        The result; values that can't be computed are None, with a warning.

    Raises:
        MissingChannelError: If the session has neither commands nor responses.
        DataError: If they hold no samples.
        UsageError: If the options leave nothing of the session.
    """
    return measure_session(session, options).analysis


def measure_session(
    session: SessionView, options: Options | None = None, *, without: Collection[str] = ()
) -> SessionMeasurement:
    """Analyse one session, and keep the intermediate data.

    Args:
        without: Names of parts that nothing asks for (:data:`.analysis.session.parts.UNCOMPARED`).
            A motion without commands is known by the body's, which is then measured all the same.
            Parts of other packages are measured where nothing is left out.

    Raises:
        MissingChannelError: If the session has neither commands nor responses.
        DataError: If they hold no samples.
        UsageError: If the options leave nothing of the session.
    """
    options, remarks = options or Options(), Remarks()
    signals = read_signals(session, options, remarks)
    added = () if without else added_parts()
    every = (*PARTS, *added)
    shown = [part for part in every if part.result is not None]
    chosen = {part.name for part in every} - {*without}
    if signals.columns.command:
        chosen -= {FREE_MOTION.name}
    done = measure(in_order(every, chosen), signals, remarks)
    session, columns = signals.session, signals.columns
    gait, artefacts, judged = done[GAIT], done[ARTEFACTS], done[JUDGEMENT]
    body, tracked = done.get(BODY, MeasuredBody()), done[TRACKING]
    analysis = Analysis(
        session=SessionFacts(
            id=session.session_id,
            path=str(session.path),
            robot=session.robot.name if session.robot is not None else None,
            start_ns=session.start_ns,
            duration_s=session.duration_s,
            verdict=session.verdict,
        ),
        gait=gait_facts(session, gait.fit, gait.span, signals.window),
        joints=done[JOINTS],
        gaits=gait_windows(session.robot, done[GAITS], session.start_ns),
        body=body.motion,
        body_shape=body.measured.shape,
        ground_contact=done.get(GROUND_CONTACT, None),
        heterogeneity=done[HETEROGENEITY],
        coupling=coupling_of_one_gait(0 if gait.fit is None else len(gait.fit.all_answered)),
        free_motion=done.get(FREE_MOTION, None),
        closed_loop=done[CLOSED_LOOP],
        warnings=remarks.warnings(session.warnings),
        provenance=_provenance(session, signals.options),
        artefacts=artefacts.whole,
        over_time=done[OVER_TIME],
        energy=done[ENERGY],
        frequency_response=done[FREQUENCY_RESPONSE],
        tracking=tracked.joints,
        oscillators=done[OSCILLATORS],
        notes=remarks.notes,
        more={part.name: checked(part, done[part]) for part in shown if done[part] is not None},
    )
    facts = Facts(
        analysis.gait,
        analysis.joints,
        columns.commanded(),
        judged.faulty,
        done[COMPARISON],
        analysis.warnings,
        frequency_response=analysis.frequency_response,
        tracking=tracked.joints,
        left_out=signals.left_out,
        motion=analysis.free_motion,
        judgement=judged.following.judgement,
        artefacts=artefacts.whole,
    )
    analysis = dataclasses.replace(analysis, answer=led(compose(facts), remarks.leading))
    return SessionMeasurement(
        analysis,
        gait.fit,
        artefacts.sound,
        done[ENERGIES].joints,
        gait.span,
        judged.following.offsets,
        motion=None if columns.command else body.measured.motion,
        cycle=body.measured.cycle,
        gait_offsets=tracked.offsets,
    )


def _engine(session: SessionView) -> dict[str, str]:
    """Return the physics engine that a session of the twin was simulated with."""
    engine = session.metadata.get("undulog", {}).get("engine")
    return {} if engine is None else {"engine of the session": engine}


def _provenance(session: SessionView, options: Options) -> Provenance:
    """What makes the same numbers again."""
    given = [] if session.robot_given is None else ["--robot", session.robot_given]
    words = ["undulog", "analyse", str(session.path), *options.arguments(), *given]
    return Provenance(
        command=shlex.join(words),
        versions=base_versions() | _engine(session),
        inputs={str(session.path): session.fingerprint()},
        options={
            **asdict(options),
            "confidence": CONFIDENCE,
            "harmonics": HARMONICS,
            "min_cycles": MIN_CYCLES,
            "min_explained": MIN_EXPLAINED,
            "bins_per_side": BINS_PER_SIDE,
            "settle_s": session.settle_s or 0.0,
            "drag_ratio": drag_ratio(session),
        },
    )
