"""The parts of the analysis of a session: what each measures, and what it needs of the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from undulog.capture.common.console import Warn

from ..estimators.series import Series
from ..parts.artefacts.measure import find_artefacts
from ..parts.body.motion import body_motion
from ..parts.body.shape import MeasuredShape, body_shape
from ..parts.comparison.examine import Findings
from ..parts.dead_band.measure import dead_bands
from ..parts.energy.measure import Energies, check_ledger, energy_result, joint_energies, transport
from ..parts.free_motion.measure import free_motion
from ..parts.frequency_response.measure import frequency_responses
from ..parts.gaits.measure import FittedGait, gaits_in_windows
from ..parts.ground_contact.measure import ground_contact
from ..parts.heterogeneity.measure import heterogeneity_indices
from ..parts.joints.measure import joint_results
from ..parts.judgement.measure import (
    Following,
    compare_joints,
    following,
    not_following,
    stopped,
    unrefuted,
)
from ..parts.oscillators.measure import closed_loop, session_couplings
from ..parts.over_time.measure import response_over_time
from ..parts.part import Part, Results
from ..parts.tracking.gait import gait_offsets
from ..parts.tracking.measure import Tracked, track_joints
from ..response.fitting import GaitFit, fit_at_period, fit_gait
from ..results.analysis import Index, JointResult
from ..results.answer import KINDS, Artefact, DeadBand, Note, NotFollowing, Remarks, flags_by_joint
from ..results.body import BodyResult, GroundContact
from ..results.cycles import Closure, EnergyResult, ResponseOverTime
from ..results.frequency_response import FreeMotion, JointFrequencyResponse
from ..results.oscillators import ChainCoupling
from ..signals.columns import by_plane
from ..signals.session_signals import Signals
from ..signals.stretch import series_in
from ..signals.windows import Span, Stretch, whole_cycles

UNDECIDED_ENDS = (
    "without a robot description the order of the joints is that of the record, and which end is "
    "the head is unknown: directions are relative to that order, and whether the wave runs towards "
    "the head or the tail isn't known; a lag from joint to joint is known up to whole turns, the "
    "smallest is given"
)


@dataclass(frozen=True)
class Judged:
    """How the joints follow their commands.

    Attributes:
        following: Of the joints that are commanded.
        faulty: Joints that don't follow.
    """

    following: Following
    faulty: tuple[NotFollowing, ...]


@dataclass(frozen=True)
class Artefacts:
    """What is wrong with samples or at a limit.

    Attributes:
        whole: Of the whole session.
        window: Those in the window.
        sound: Positions in the window of the joints whose positions are not falsified.
    """

    whole: tuple[Artefact, ...]
    window: tuple[Artefact, ...]
    sound: Mapping[str, Series]


@dataclass(frozen=True)
class MeasuredGait:
    """The gait of the window.

    Attributes:
        fit: None where there is none.
        span: Its whole cycles; the window where there is no gait.
    """

    fit: GaitFit | None
    span: Span


@dataclass(frozen=True)
class MeasuredEnergy:
    """Energies of the joints.

    Attributes:
        joints: By name.
        closure: Against the twin's ledger, or None.
    """

    joints: Mapping[str, Energies]
    closure: Closure | None


@dataclass(frozen=True)
class MeasuredBody:
    """What is measured of the whole body."""

    motion: BodyResult | None = None
    measured: MeasuredShape = dataclasses.field(default_factory=MeasuredShape)
    contact: GroundContact | None = None


def _judgement(signals: Signals, done: Results, remarks: Remarks) -> Judged:
    follows = following(signals.session, signals.columns, signals.recorded)
    return Judged(follows, not_following(follows))


JUDGEMENT = Part("judgement", _judgement)


def _artefacts(signals: Signals, done: Results, remarks: Remarks) -> Artefacts:
    suspected = find_artefacts(signals.session, signals.columns)
    artefacts = unrefuted(suspected, done[JUDGEMENT].following)
    limits_s = signals.window.since(signals.start_ns)
    held = tuple(artefact for artefact in artefacts if artefact.within(*limits_s))
    false = [artefact.joint for artefact in held if artefact.falsifies("position")]
    sound = {name: series for name, series in signals.responses.items() if name not in false}
    return Artefacts(artefacts, held, sound)


ARTEFACTS = Part("artefacts", _artefacts, ("judgement",))


def _gait(signals: Signals, done: Results, remarks: Remarks) -> MeasuredGait:
    """Fit the gait; a motion without commands at the period that the user states, if any."""
    sound, period_s = done[ARTEFACTS].sound, signals.options.period_s
    duration_s = signals.window.duration_s
    if period_s is None or signals.commands:
        if period_s is not None:
            remarks(Note("--period is of motions without commands: the commands have their own"))
        fit = fit_gait(signals.commands, sound, duration_s, remarks)
    else:
        fit = fit_at_period(sound, period_s, duration_s, remarks)
    return MeasuredGait(fit, _span(signals.window, signals.origin_ns, fit))


def _span(window: Stretch, origin_ns: int, gait: GaitFit | None) -> Span:
    start_s, stop_s = window.since(origin_ns)
    if gait is None:
        return Span(origin_ns, start_s, stop_s, 0)
    first_s, stop_s, cycles = whole_cycles(start_s, stop_s, gait.fit.frequency_hz)
    return Span(origin_ns, first_s, stop_s, cycles)


GAIT = Part("gait", _gait, ("artefacts",), of_commands=True)


def _dead_bands(signals: Signals, done: Results, remarks: Remarks) -> Mapping[str, DeadBand]:
    """Measure dead bands; plateaus of stopped joints are none."""
    still = stopped(done[JUDGEMENT].faulty)
    moving = {n: series for n, series in done[ARTEFACTS].sound.items() if n not in still}
    fit = done[GAIT].fit
    return dead_bands(signals.columns, signals.commands, moving, fit, signals.origin_ns)


DEAD_BAND = Part("dead_band", _dead_bands, ("judgement", "artefacts", "gait"), of_commands=True)


def _frequency_response(
    signals: Signals, done: Results, remarks: Remarks
) -> tuple[JointFrequencyResponse, ...]:
    if done[GAIT].fit is not None or remarks.refused:
        return ()
    columns, window = signals.columns, signals.window
    excitation = series_in(columns.names, columns.excitation, window, signals.origin_ns)
    return frequency_responses(signals.commands, done[ARTEFACTS].sound, remarks, excitation)


FREQUENCY_RESPONSE = Part(
    "frequency_response", _frequency_response, ("artefacts", "gait"), of_commands=True
)


def _tracking(signals: Signals, done: Results, remarks: Remarks) -> Tracked:
    """Measure how joints follow commands that are no gait, and compare those of one plane.

    Of a gait's joints only the offsets are measured here.

    Beside a gait they aren't compared: it is a few joints whose commands are none. Frames of made
    times hold what was sampled earlier or later: their joints aren't compared either, nor are those
    that the judgement names.
    """
    if remarks.refused:
        return Tracked()
    gait, sound, follows = done[GAIT].fit, done[ARTEFACTS].sound, done[JUDGEMENT].following
    answered = () if gait is None else gait.all_answered
    others = {name: series for name, series in signals.commands.items() if name not in answered}
    alone = follows.in_frames or gait is not None
    planes = by_plane(signals.robot, () if alone else others).values()
    judged = follows.judgement
    statements = (*judged.faults, *judged.changes, *judged.extra, *judged.apart)
    tracked = track_joints(others, sound, planes, {statement.joint for statement in statements})
    offsets = {} if gait is None else gait_offsets(gait, sound)
    return dataclasses.replace(tracked, offsets=offsets)


TRACKING = Part("tracking", _tracking, ("judgement", "artefacts", "gait"), of_commands=True)


def _gaits(signals: Signals, done: Results, remarks: Remarks) -> list[FittedGait]:
    """Fit the gait of each window in which it is constant."""
    columns, longest = signals.columns, done[GAIT].fit
    whole = done[ARTEFACTS].whole
    return gaits_in_windows(columns, signals.choice, longest, whole, signals.start_ns)


GAITS = Part("gaits", _gaits, ("artefacts", "gait"))


def _energies(signals: Signals, done: Results, remarks: Remarks) -> MeasuredEnergy:
    session, span = signals.session, done[GAIT].span
    held = done[ARTEFACTS].window
    energies = joint_energies(session, signals.columns, held, span, remarks)
    return MeasuredEnergy(energies, check_ledger(session, energies.values(), span, remarks))


ENERGIES = Part("energies", _energies, ("artefacts", "gait"))


def _joints(signals: Signals, done: Results, remarks: Remarks) -> tuple[JointResult, ...]:
    held, gait = done[ARTEFACTS].window, done[GAIT]
    joints = joint_results(
        signals.robot,
        signals.columns,
        responses=signals.responses,
        gait=gait.fit,
        energies=done[ENERGIES].joints,
        flags=flags_by_joint(held),
        dead=done.get(DEAD_BAND, {}),
        offsets=done[TRACKING].offsets,
        span=gait.span,
    )
    _warn_flags(held, joints, gait.fit, remarks)
    return joints


JOINTS = Part("joints", _joints, ("artefacts", "gait", "tracking", "energies"), ("dead_band",))


def _energy(signals: Signals, done: Results, remarks: Remarks) -> EnergyResult | None:
    session, span, energies = signals.session, done[GAIT].span, done[ENERGIES]
    cost = transport(session, done[ARTEFACTS].sound, energies.joints, span, remarks)
    session.forget()
    return energy_result(
        session,
        signals.columns,
        energies.joints,
        span,
        transport=cost,
        closure=energies.closure,
        warn=remarks,
    )


ENERGY = Part("energy", _energy, ("artefacts", "gait", "energies"))


def _over_time(signals: Signals, done: Results, remarks: Remarks) -> ResponseOverTime | None:
    return response_over_time(signals.session, signals.columns, done[ARTEFACTS].whole, remarks)


OVER_TIME = Part("over_time", _over_time, ("artefacts",))


def _body(signals: Signals, done: Results, remarks: Remarks) -> MeasuredBody:
    session, responses = signals.session, signals.responses
    sound, gait = done[ARTEFACTS].sound, done[GAIT]
    fit, span = gait.fit, gait.span
    return MeasuredBody(
        motion=body_motion(session, sound, fit, span, remarks),
        measured=body_shape(session, responses, sound, fit, span=span, warn=remarks),
        contact=ground_contact(session, signals.columns, sound, span=span, warn=remarks),
    )


BODY = Part("body", _body, ("artefacts", "gait"))


def _heterogeneity(signals: Signals, done: Results, remarks: Remarks) -> dict[str, Index]:
    fit, joints = done[GAIT].fit, done[JOINTS]
    return heterogeneity_indices(signals.robot, fit, joints, done[ENERGIES].joints, remarks)


HETEROGENEITY = Part("heterogeneity", _heterogeneity, ("gait", "energies", "joints"))


def _comparison(signals: Signals, done: Results, remarks: Remarks) -> Findings:
    """Compare joints: those of a gait over all its windows, others by how they track."""
    gait, judged = done[GAIT].fit, done[JUDGEMENT]
    if gait is None:
        return Findings(stand_out=done[TRACKING].stand_out)
    return compare_joints(
        signals.robot,
        [window.fit for window in done[GAITS]] or [gait],
        done[JOINTS],
        faulty=judged.faulty,
        commanded=signals.columns.commanded(),
        offsets=judged.following.offsets,
    )


COMPARISON = Part("comparison", _comparison, ("judgement", "gait", "tracking", "gaits", "joints"))


def _free_motion(signals: Signals, done: Results, remarks: Remarks) -> FreeMotion | None:
    """Measure a motion without commands; None where there are some."""
    if signals.columns.command:
        return None
    moved = done[BODY].measured.motion
    if moved is None:
        return FreeMotion()
    motion, open_phases = free_motion(signals.robot, moved)
    if open_phases:
        remarks(
            f"{', '.join(open_phases)}: no motion at the common frequency that differs from noise: "
            "its phase is null"
        )
    if motion.waves and signals.robot is None:
        remarks(Note(UNDECIDED_ENDS))
    return motion


FREE_MOTION = Part("free_motion", _free_motion, ("body",))


def _closed_loop(signals: Signals, done: Results, remarks: Remarks) -> str | None:
    responses = done[FREQUENCY_RESPONSE]
    return closed_loop(signals.session, signals.options, responses, remarks)


CLOSED_LOOP = Part("closed_loop", _closed_loop, ("frequency_response",))


def _oscillators(signals: Signals, done: Results, remarks: Remarks) -> tuple[ChainCoupling, ...]:
    options = signals.options
    return session_couplings(signals.session, options.start_s, options.stop_s)


OSCILLATORS = Part("oscillators", _oscillators)

PARTS: tuple[Part[Any], ...] = (
    JUDGEMENT,
    ARTEFACTS,
    GAIT,
    DEAD_BAND,
    FREQUENCY_RESPONSE,
    TRACKING,
    GAITS,
    ENERGIES,
    JOINTS,
    ENERGY,
    OVER_TIME,
    BODY,
    HETEROGENEITY,
    COMPARISON,
    FREE_MOTION,
    CLOSED_LOOP,
    OSCILLATORS,
)
"""All parts of this package. Of those that could be next, the first is measured first."""


def _warn_flags(
    artefacts: Iterable[Artefact], joints: tuple[JointResult, ...], gait: GaitFit | None, warn: Warn
) -> None:
    """Warn of each kind of artefact with its joints, and of responses lost in noise."""
    joined: dict[tuple[str, str, str], list[Artefact]] = {}
    for artefact in artefacts:
        key = artefact.flag, artefact.quantity, artefact.topic
        joined.setdefault(key, []).append(artefact)
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
        notes = ", ".join(dict.fromkeys(artefact.note for artefact in same if artefact.note))
        named = f"{flag}, {notes}" if notes else flag
        names = ", ".join(artefact.joint for artefact in same)
        warn(f"{names}: {where}: values {text} ({named}): {meaning}")
    if holed := [joint.name for joint in joints if "gaps" in joint.flags]:
        warn(f"{', '.join(holed)}: positions have gaps (an artefact of the record, not mechanics)")
    answered = () if gait is None else gait.all_answered
    silent = [joint.name for joint in joints if joint.lag_rad.value is None]
    if lost := [name for name in silent if name in answered]:
        warn(
            f"{', '.join(lost)}: no response at the gait frequency that differs from noise: "
            "gain and lag are null"
        )
