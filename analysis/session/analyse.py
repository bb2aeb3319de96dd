"""Analyse one session: the orchestration of all estimators."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.common.extras import base_versions
from undulog.capture.log.health.rules import judge_made_times
from undulog.capture.robot.model import Robot

from ..body.free_motion import MotionFit, free_motion
from ..body.ground_contact import ground_contact
from ..body.motion import body_motion
from ..body.shape import MeasuredShape, body_shape
from ..dead_band.find import dead_bands
from ..energy import check_ledger, energy_result, joint_energies, transport
from ..estimators.intervals import CONFIDENCE
from ..estimators.series import Series
from ..estimators.spectrum import BINS_PER_SIDE
from ..oscillators.chain import closed_loop, session_couplings
from ..parts.tracking.gait import gait_offsets
from ..parts.tracking.measure import Tracked, track_joints
from ..response.fitting import GaitFit, fit_at_period, fit_gait
from ..response.frequency_response import frequency_responses
from ..response.rhythm import HARMONICS, MIN_CYCLES, MIN_EXPLAINED
from ..results.analysis import Analysis, JointResult, SessionFacts
from ..results.answer import KINDS, Artefact, Note, Remarks, flags_by_joint, led
from ..results.body import BodyResult, GroundContact
from ..results.estimate import Provenance
from ..results.frequency_response import FreeMotion
from ..segments.answer import Facts, compose
from ..segments.examine import Findings
from ..segments.session import (
    Following,
    compare_joints,
    following,
    not_following,
    stopped,
    unrefuted,
)
from ..signals.artefacts import find_artefacts
from ..signals.columns import Columns, by_plane, drag_ratio, read_columns
from ..signals.stretch import (
    Options,
    choose_stretch,
    fetched_part,
    recorded,
    series_in,
    without_breaks,
)
from ..signals.windows import Span, Stretch, whole_cycles
from .cycles import response_over_time
from .fields import SessionMeasurement, gait_facts, joint_results
from .gaits import gait_windows, gaits_in_windows
from .heterogeneity import heterogeneity_indices
from .runs import coupling_of_one_gait

UNDECIDED_ENDS = (
    "without a robot description the order of the joints is that of the record, and which end is "
    "the head is unknown: directions are relative to that order, and whether the wave runs towards "
    "the head or the tail isn't known; a lag from joint to joint is known up to whole turns, the "
    "smallest is given"
)

_FEW = 1e-3
"""Up to one sample in a thousand left out is a note: no loss for a fit."""


def _warn_flags(
    artefacts: Iterable[Artefact], joints: tuple[JointResult, ...], gait: GaitFit | None, warn: Warn
) -> None:
    """Warn of each kind of artefact with its joints, and of responses lost in noise."""
    joined: dict[tuple[str, str, str], list[Artefact]] = {}
    for artefact in artefacts:
        joined.setdefault((artefact.flag, artefact.quantity, artefact.topic), []).append(artefact)
    for (flag, quantity, topic), same in joined.items():
        if flag == "gaps":  # of the whole session; those that matter are in the joints' flags
            continue
        about, text = KINDS[flag]
        where = f"{quantity} on {topic}" if topic else quantity
        nulls = "; gain and lag are null" if same[0].falsifies("position") else ""
        meaning = {
            "sensor": f"an artefact of the sensor, not mechanics{nulls}",
            "sensor or joint": f"the sensor or the joint itself, see the answer{nulls}",
            "sensor or limit": "the sensor or a limit of the servo",
            "record": "an artefact of the record, not mechanics",
            "limit": "a limit of the robot, not a fault of the sensor",
        }[about]
        notes = ", ".join(dict.fromkeys(one.note for one in same if one.note))
        named = f"{flag}, {notes}" if notes else flag
        warn(f"{', '.join(one.joint for one in same)}: {where}: values {text} ({named}): {meaning}")
    if holed := [joint.name for joint in joints if "gaps" in joint.flags]:
        warn(f"{', '.join(holed)}: positions have gaps (an artefact of the record, not mechanics)")
    answered = () if gait is None else gait.all_answered
    silent = [joint.name for joint in joints if joint.lag_rad.value is None]
    if lost := [name for name in silent if name in answered]:
        warn(
            f"{', '.join(lost)}: no response at the gait frequency that differs from noise: "
            "gain and lag are null"
        )


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
    session: SessionView,
    options: Options | None = None,
    *,
    with_dead_bands: bool = True,
    with_body: bool = True,
) -> SessionMeasurement:
    """Analyse one session, and keep the intermediate data.

    Args:
        with_dead_bands: Whether to fit them, which takes a third of the time of a short session
            and changes nothing else.
        with_body: Whether to measure the body's motion, shape and ground contact, which takes two
            fifths of the time of a long session and changes nothing else.

    Raises:
        MissingChannelError: If the session has neither commands nor responses.
        DataError: If they hold no samples.
        UsageError: If the options leave nothing of the session.
    """
    options = options or Options()
    warn = Remarks()
    session = fetched_part(session, options, warn)
    columns, options = _read(session, options, warn)
    for finding in judge_made_times(session.metadata.get("undulog", {})):
        warn(finding.sentence)
    columns, left_out = without_breaks(session, columns, options, warn)
    session.forget()  # what each step has looked at need not stay in memory beside the next one's
    choice = choose_stretch(session, columns, options, warn)
    stretch, start_ns = choice.stretch, session.start_ns
    whole = recorded(session, columns, options)
    origin_ns = stretch.start_ns + (stretch.stop_ns - stretch.start_ns) // 2
    commands = series_in(columns.names, columns.command, stretch, origin_ns)
    session.forget()
    responses = series_in(columns.names, columns.position, stretch, origin_ns)
    _warn_dropped(commands, responses, warn)
    session.forget()
    follows = following(session, columns, whole)
    artefacts = unrefuted(find_artefacts(session, columns), follows)
    held = tuple(artefact for artefact in artefacts if artefact.within(*stretch.since(start_ns)))
    session.forget()
    false = [one.joint for one in held if one.falsifies("position")]
    sound = {name: response for name, response in responses.items() if name not in false}
    gait = _gait(commands, sound, stretch.duration_s, options.period_s, warn)
    span = _span(stretch, origin_ns, gait)
    faulty = not_following(follows)
    # Plateaus of stopped joints are no dead bands.
    moving = {name: one for name, one in sound.items() if name not in stopped(faulty)}
    dead = dead_bands(columns, commands, moving, gait, origin_ns) if with_dead_bands else {}
    excitation = series_in(columns.names, columns.excitation, stretch, origin_ns)
    swept = (
        ()
        if gait is not None or warn.refused
        else frequency_responses(commands, sound, warn, excitation)
    )
    tracked = Tracked() if warn.refused else _tracked(session.robot, commands, sound, gait, follows)
    del commands
    session.forget()
    gaits = gaits_in_windows(columns, choice, gait, artefacts, start_ns)
    energies = joint_energies(session, columns, held, span, warn)
    closure = check_ledger(session, energies.values(), span, warn)
    joints = joint_results(
        session.robot,
        columns,
        responses=responses,
        gait=gait,
        energies=energies,
        flags=flags_by_joint(held),
        dead=dead,
        offsets=tracked.offsets,
        span=span,
    )
    _warn_flags(held, joints, gait, warn)
    cost = transport(session, sound, energies, span, warn)
    session.forget()
    energy = energy_result(
        session, columns, energies, span, transport=cost, closure=closure, warn=warn
    )
    session.forget()
    over_time = response_over_time(session, columns, artefacts, warn)
    body = (
        _body(session, columns, responses, sound, gait, span=span, warn=warn)
        if with_body or not columns.command  # a motion without commands is known by the body's
        else _NO_BODY
    )
    heterogeneity = heterogeneity_indices(session.robot, gait, joints, energies, warn)
    commanded = columns.commanded()
    findings = (
        Findings(stand_out=tracked.stand_out)
        if gait is None
        else compare_joints(
            session.robot,
            [gait.fit for gait in gaits] or [gait],
            joints,
            faulty=faulty,
            commanded=commanded,
            offsets=follows.offsets,
        )
    )
    analysis = Analysis(
        session=SessionFacts(
            id=session.session_id,
            path=str(session.path),
            robot=session.robot.name if session.robot is not None else None,
            start_ns=session.start_ns,
            duration_s=session.duration_s,
            verdict=session.verdict,
        ),
        gait=gait_facts(session, gait, span, stretch),
        joints=joints,
        gaits=gait_windows(session.robot, gaits, start_ns),
        body=body.motion,
        body_shape=body.measured.shape,
        ground_contact=body.contact,
        heterogeneity=heterogeneity,
        coupling=coupling_of_one_gait(0 if gait is None else len(gait.all_answered)),
        free_motion=None
        if columns.command
        else _free_motion(session.robot, body.measured.motion, warn),
        closed_loop=closed_loop(session, options, swept, warn),
        warnings=warn.warnings(session.warnings),
        provenance=_provenance(session, options),
        artefacts=artefacts,
        over_time=over_time,
        energy=energy,
        frequency_response=swept,
        tracking=tracked.joints,
        oscillators=session_couplings(session, options.start_s, options.stop_s),
        notes=warn.notes,
    )
    facts = Facts(
        analysis.gait,
        joints,
        commanded,
        faulty,
        findings,
        analysis.warnings,
        frequency_response=swept,
        tracking=tracked.joints,
        left_out=left_out,
        motion=analysis.free_motion,
        judgement=follows.judgement,
        artefacts=artefacts,
    )
    analysis = dataclasses.replace(analysis, answer=led(compose(facts), warn.leading))
    return SessionMeasurement(
        *(analysis, gait, sound, energies, span, follows.offsets),
        motion=None if columns.command else body.measured.motion,
        cycle=body.measured.cycle,
        gait_offsets=tracked.offsets,
    )


def _read(session: SessionView, options: Options, warn: Warn) -> tuple[Columns, Options]:
    """Read the joints' columns; the options then name the topics that they are of."""
    columns = read_columns(
        session,
        options.command_topic,
        options.response_topic,
        warn,
        reference_topic=options.reference_topic,
        excitation_topic=options.excitation_topic,
    )
    return columns, dataclasses.replace(
        options,
        command_topic=columns.topics.get("command", options.command_topic),
        response_topic=columns.topics.get("position", options.response_topic),
    )


def _gait(
    commands: Mapping[str, Series],
    sound: Mapping[str, Series],
    duration_s: float,
    period_s: float | None,
    warn: Warn,
) -> GaitFit | None:
    """Fit the gait; a motion without commands at the period that the user states, if any."""
    if period_s is None or commands:
        if period_s is not None:
            warn(Note("--period is of motions without commands: the commands have their own"))
        return fit_gait(commands, sound, duration_s, warn)
    return fit_at_period(sound, period_s, duration_s, warn)


@dataclass(frozen=True)
class _Body:
    """What is measured of the whole body."""

    motion: BodyResult | None
    measured: MeasuredShape
    contact: GroundContact | None


_NO_BODY = _Body(None, MeasuredShape(), None)


def _body(
    session: SessionView,
    columns: Columns,
    responses: Mapping[str, Series],
    sound: Mapping[str, Series],
    gait: GaitFit | None,
    *,
    span: Span,
    warn: Warn,
) -> _Body:
    return _Body(
        motion=body_motion(session, sound, gait, span, warn),
        measured=body_shape(session, responses, sound, gait, span=span, warn=warn),
        contact=ground_contact(session, columns, sound, span=span, warn=warn),
    )


def _free_motion(robot: Robot | None, moved: MotionFit | None, warn: Warn) -> FreeMotion:
    """Measure a motion without commands."""
    if moved is None:
        return FreeMotion()
    motion, open_phases = free_motion(robot, moved)
    if open_phases:
        warn(
            f"{', '.join(open_phases)}: no motion at the common frequency that differs from noise: "
            "its phase is null"
        )
    if motion.waves and robot is None:
        warn(Note(UNDECIDED_ENDS))
    return motion


def _tracked(
    robot: Robot | None,
    commands: Mapping[str, Series],
    sound: Mapping[str, Series],
    gait: GaitFit | None,
    follows: Following,
) -> Tracked:
    """Measure how joints follow commands that are no gait, and compare those of one plane.

    Of a gait's joints only the offsets are measured here.

    Beside a gait they aren't compared: it is a few joints whose commands are none. Frames of made
    times hold what was sampled earlier or later: their joints aren't compared either, nor are those
    that the judgement names.
    """
    answered = () if gait is None else gait.all_answered
    others = {name: series for name, series in commands.items() if name not in answered}
    alone = follows.in_frames or gait is not None
    planes = by_plane(robot, () if alone else others).values()
    judged = follows.judgement
    statements = (*judged.faults, *judged.changes, *judged.extra, *judged.apart)
    tracked = track_joints(others, sound, planes, {statement.joint for statement in statements})
    offsets = {} if gait is None else gait_offsets(gait, sound)
    return dataclasses.replace(tracked, offsets=offsets)


def _warn_dropped(
    commands: Mapping[str, Series], responses: Mapping[str, Series], warn: Warn
) -> None:
    for kind, series in (("command", commands), ("response", responses)):
        lost = [
            channel
            for channel in series.values()
            if channel.dropped_nan or channel.dropped_duplicates
        ]
        if lost:
            nan = sum(one.dropped_nan for one in lost)
            double = sum(one.dropped_duplicates for one in lost)
            text = (
                f"left out of the {kind}s: {nan} samples that are not numbers and {double} with a "
                f"time that was there already ({', '.join(one.name for one in lost)})"
            )
            few = nan + double <= _FEW * sum(channel.count for channel in series.values())
            warn(Note(text) if few else text)


def _span(stretch: Stretch, origin_ns: int, gait: GaitFit | None) -> Span:
    start_s, stop_s = stretch.since(origin_ns)
    if gait is None:
        return Span(origin_ns, start_s, stop_s, 0)
    first_s, stop_s, cycles = whole_cycles(start_s, stop_s, gait.fit.frequency_hz)
    return Span(origin_ns, first_s, stop_s, cycles)


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
