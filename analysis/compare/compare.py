"""Compare two sessions, or two groups of them, joint by joint.

They can be compared where the same commands drove the same joints, and by their motion where no
session has commands.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TypeVar

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray
from undulog.capture.common.console import Warn, plain
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.common.extras import base_versions

from ..common.answer import NotFollowing, StandOut
from ..common.estimate import Estimate, Provenance
from ..estimators.intervals import CONFIDENCE, around, t_factor
from ..parts.comparison.examine import OFFSET_RAD
from ..parts.comparison.words import deviation_in_words, fault_in_words
from ..results.comparison import BrokenJoint, Comparison, Waveform
from ..session.runs import GaitRun, command_difference, other_frequency
from ..signals.stretch import Options
from .decisions import (
    DIFFERS,
    MOVED,
    Margins,
    answer_of,
    decide,
    differ,
    estimates_of,
    family,
    moved_offsets,
)
from .quantities import PeriodicMotion, Quantities, common_motion, motion_estimates
from .side import ComparedSession, changes, one_robot, phases_rad, see, turned
from .tracking import at_one_command, commands_differ, fastest_rad_s


def broken_joints(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession]
) -> tuple[BrokenJoint, ...]:
    """Find the joints that do not follow, or stand off their command, on one side only.

    Returns:
        The joints in the order of the answers, those that do not follow first.
    """
    joints: list[BrokenJoint] = []
    for side, sessions, other in (("B", b, a), ("A", a, b)):
        answers = [session.analysis.answer for session in sessions]
        elsewhere = {
            fault.joint for session in other for fault in session.analysis.answer.not_following
        }
        for fault in _first([fault for answer in answers for fault in answer.not_following]):
            if fault.joint not in elsewhere:
                text = f"in {side} {fault_in_words(fault)}"
                joints.append(BrokenJoint(fault.joint, side, fault.kinds, text))
        names = {joint.name for joint in joints}
        stand_out = [deviation for answer in answers for deviation in answer.stand_out]
        for deviation in _first(
            [deviation for deviation in stand_out if deviation.quantity == "offset"]
        ):
            if deviation.joint not in names | elsewhere and _moved(
                deviation.joint, sessions, other
            ):
                text = f"in {side} {plain(deviation.joint)} has {deviation_in_words(deviation)}"
                joints.append(BrokenJoint(deviation.joint, side, (), text))
    return tuple(sorted(joints, key=lambda joint: not joint.kinds))


def _moved(
    joint: str, sessions: Sequence[ComparedSession], other: Sequence[ComparedSession]
) -> bool:
    """Return whether a joint's mean differs between the sides, too: both may share a zero."""
    sides = [
        [session.offsets[joint] for session in side if joint in session.offsets]
        for side in (sessions, other)
    ]
    if not all(sides):
        return True
    here, there = (float(np.median(side)) for side in sides)
    return abs(here - there) > OFFSET_RAD


_Entry = TypeVar("_Entry", NotFollowing, StandOut)


def _first(several: Sequence[_Entry]) -> list[_Entry]:
    """Return the first entry of each joint."""
    entries: dict[str, _Entry] = {}
    for entry in several:
        entries.setdefault(entry.joint, entry)
    return list(entries.values())


@dataclass(frozen=True)
class Alignment:
    """Common joints and gait of the sessions of both sides.

    Attributes:
        names: Joints that can be compared, head to tail.
        left_out: Joints that can't, and why.
        gaits_differ: How the gaits differ, or None.
        commands_differ: How the commands of joints differ that are no gait, or None.
    """

    names: tuple[str, ...]
    left_out: dict[str, str]
    gaits_differ: str | None
    commands_differ: str | None = None


def align(a: Sequence[GaitRun], b: Sequence[GaitRun], *, any_gait: bool = False) -> Alignment:
    """Find the joints that can be compared.

    Args:
        a: Runs of one side, at least one.
        b: Runs of the other, at least one.
        any_gait: Compare the responses although the gaits differ.

    Raises:
        DataError: If a session has no gait, no joint is in all of them, or the gaits differ and
            that is not allowed.
    """
    runs = [*a, *b]
    for run in runs:
        if not run.names:
            raise DataError(
                f"{run.label} has no gait, so there is no gait phase to align it by, and others "
                "have one: compare sessions with a gait, or sessions without"
            )
    for side, side_runs in (("A", a), ("B", b)):
        _refuse_copies([(run.label, run.ratio) for run in side_runs], side)
    joints = list(dict.fromkeys(name for run in runs for name in run.names))
    answered = [
        {name for name, ratio in zip(run.names, run.ratio, strict=True) if np.isfinite(ratio)}
        for run in runs
    ]
    names = tuple(name for name in joints if all(name in run_joints for run_joints in answered))
    if not names:
        raise DataError(
            f"no joint has gain and lag in all sessions: {a[0].label} drives "
            f"{_some(a[0].names)}, {b[0].label} {_some(b[0].names)}"
        )
    left_out = {
        name: "no gain and lag in "
        + ", ".join(
            r.label for r, run_joints in zip(runs, answered, strict=True) if name not in run_joints
        )
        for name in joints
        if name not in names
    }
    faults = [fault for run in runs[1:] if (fault := gait_fault(run, runs[0], names)) is not None]
    if faults and not any_gait:
        raise DataError(
            f"the gaits differ, so joints would answer differently anyway: {faults[0]}; record the "
            "same gait, or compare nevertheless with --any-gait"
        )
    return Alignment(names, left_out, faults[0] if faults else None)


def align_commanded(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession], *, any_gait: bool = False
) -> Alignment:
    """Find the joints of sessions with commands that can be compared, of gaits or of any motion.

    Args:
        a: Sessions of one side, at least one.
        b: Sessions of the other, at least one.
        any_gait: Compare the responses although the gaits differ.

    Raises:
        DataError: If no joint can be compared, only some sessions have a gait, or the gaits differ
            and that is not allowed.
    """
    sides = [[session.analysis.tracking for session in side] for side in (a, b)]
    with_delay = [
        {place for quantity, place in session.estimates if quantity == "delay"}
        for session in (*a, *b)
    ]
    tracked = [
        joint.joint for joint in sides[0][0] if all(joint.joint in names for names in with_delay)
    ]
    if tracked and not any(session.run.names for session in (*a, *b)):
        for side, sessions in (("A", a), ("B", b)):
            _refuse_copies(
                [(session.run.label, _numbers(session, tracked)) for session in sessions], side
            )
        aligned = Alignment((), {}, None)
    else:
        aligned = align(
            [session.run for session in a], [session.run for session in b], any_gait=any_gait
        )
    some = {name for names in with_delay for name in names} - {*tracked, *aligned.names}
    left_out = dict.fromkeys(sorted(some), "no gain, lag and offset in all sessions")
    return replace(
        aligned,
        names=(*aligned.names, *(name for name in tracked if name not in aligned.names)),
        left_out={**left_out, **aligned.left_out},
        commands_differ=commands_differ(sides[0], sides[1], tracked),
    )


def _numbers(session: ComparedSession, names: Sequence[str]) -> ComplexArray:
    """Return what a copy of a session has, too."""
    keys = [(quantity, name) for quantity in ("gain", "delay", "offset") for name in names]
    return np.array([session.estimates[key][0] for key in keys], np.complex128)


def gait_fault(run: GaitRun, model: GaitRun, names: Sequence[str]) -> str | None:
    """Return the difference of a run's gait from the model's.

    Args:
        model: The run that it is held against.
        names: Joints to look at, driven in both.

    Returns:
        The reason, or None within 0.5 % of the frequency and 1 % of every command's amplitude.
    """
    if (different := other_frequency(run, model)) is not None:
        return f"{run.label} has {different[0]} Hz, {model.label} {different[1]} Hz"
    command, other = (
        np.array([gait.command[gait.names.index(name)] for name in names]) for gait in (run, model)
    )
    groups, others = (
        [gait.group[gait.names.index(name)] for name in names] for gait in (run, model)
    )
    if groups != others:
        return f"{run.label} has other joints than {model.label} at one frequency"
    members = [np.flatnonzero(np.array(groups) == group) for group in set(groups)]
    if (off := command_difference(command, other, members)) is None:
        return None
    worst, percent, degrees = off
    return (
        f"at {names[worst]} the command of {run.label} is {percent} % in amplitude and {degrees} "
        f"degrees in phase off that of {model.label}"
    )


def _refuse_copies(runs: Sequence[tuple[str, ComplexArray]], side: str) -> None:
    """Raise an error for copies: two copies of one run would show no scatter.

    Args:
        runs: Label and numbers of each.
    """
    seen: dict[bytes, str] = {}
    for label, values in runs:
        numbers = values.tobytes()
        if numbers in seen:
            raise DataError(
                f"{label} is a copy of the numbers of {seen[numbers]} on side {side}: a copy "
                "is not a run of its own"
            )
        seen[numbers] = label


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")


@dataclass(frozen=True)
class Choices:
    """Options of a comparison.

    Attributes:
        paired: Run i of B belongs to run i of A, e.g. recorded one after the other.
        any_gait: Compare although the gaits differ.
        margins: Differences that count as the same.
        session: Options of the analysis of each session.
    """

    paired: bool = False
    any_gait: bool = False
    margins: Margins = field(default_factory=Margins)
    session: Options = field(default_factory=Options)


def compare_sessions(
    a: SessionView | Iterable[SessionView],
    b: SessionView | Iterable[SessionView],
    choices: Choices | None = None,
) -> Comparison:
    """Compare two sessions, or two groups of runs: B minus A.

    Args:
        a: An open session, or several, each used once and in turn.

    Raises:
        MissingChannelError: If a session has neither commands nor responses.
        DataError: If sessions have no gait or periodic motion, no joint in common or another gait,
            or only some have commands.
        UsageError: If a side has no session, a group has one run, or runs don't pair up.
    """
    choices = choices or Choices()
    warnings: dict[str, list[str]] = {}

    def seen(session: SessionView) -> ComparedSession:
        def warn(sentence: str) -> None:
            warnings.setdefault(sentence, []).append(session.path.name)

        return see(session, choices.session, warn)

    groups = ([side] if isinstance(side, SessionView) else side for side in (a, b))
    sides = [list(map(seen, group)) for group in groups]
    every = sum(map(len, sides))
    noted = [
        f"{sentence} ({'all sessions' if len(names) == every else ', '.join(names)})"
        for sentence, names in warnings.items()
    ]
    return compare_fitted(sides[0], sides[1], choices, noted)


def compare_fitted(
    a: Sequence[ComparedSession],
    b: Sequence[ComparedSession],
    choices: Choices,
    warnings: Sequence[str] = (),
) -> Comparison:
    """Compare sessions that are measured.

    Args:
        warnings: Warnings of the sessions.

    Raises:
        DataError: If sessions have no gait or periodic motion, no joint in common or another gait,
            or only some have commands.
        UsageError: If a side has no session, a group has one run, or runs don't pair up.
    """
    if not a or not b:
        raise UsageError("a comparison needs at least one session a side")
    every_warning = list(warnings)
    design = "pairs" if choices.paired else "sessions" if len(a) == len(b) == 1 else "groups"
    if free := _without_commands(a, b):
        a, b, aligned, before = _align_motions(a, b)
    else:
        before: Mapping[str, str] = {}
        aligned = align_commanded(a, b, any_gait=choices.any_gait)
        a, b = _at_one_command(a, b)
    keys = family(a, b, aligned.names)
    # Lags near pi must not part company: all are taken within pi of the first session's.
    about = np.array([a[0].estimates[key][0] for key in keys])
    estimates = [estimates_of(side, keys, about) for side in (a, b)]
    first, second, differences = differ(estimates[0], estimates[1], design)
    rate_rad_s = fastest_rad_s(session.analysis.tracking for session in (*a, *b)) or 1.0
    decided = decide(
        *(keys, first, second, differences, choices.margins), before=before, rate_rad_s=rate_rad_s
    )
    partial = _partial(aligned, " by their phase" if free else "")
    _warn(a, b, design, every_warning.append)
    moved = {offset.place for offset in moved_offsets(decided)}
    # What stands off on one side is stated by the difference, which has an interval.
    broken = tuple(joint for joint in broken_joints(a, b) if joint.kinds or joint.name not in moved)
    alike = one_robot([session.facts for session in (*a, *b)]) and aligned.commands_differ is None
    verb = MOVED if alike and aligned.gaits_differ is None else DIFFERS
    verdict, sentence = answer_of(decided, partial is not None, broken, verb)
    return Comparison(
        answer=sentence,
        verdict=verdict,
        design=design,
        a=tuple(session.analysis.session for session in a),
        b=tuple(session.analysis.session for session in b),
        broken=broken,
        partial=partial,
        changed=changes([session.facts for session in a], [session.facts for session in b]),
        **vars(decided),
        phase_rad=tuple(phases_rad().tolist()),
        waveforms=_waveforms(a, b, aligned.names, design),
        warnings=tuple(every_warning),
        provenance=_provenance(a, b, choices),
    )


def _without_commands(a: Sequence[ComparedSession], b: Sequence[ComparedSession]) -> bool:
    """Return whether no session has commands.

    Raises:
        DataError: If only some of them have.
    """
    commanded = [session for session in (*a, *b) if session.commanded]
    free = [session for session in (*a, *b) if not session.commanded]
    if commanded and free:
        without, other = free[0].run.label, commanded[0].run.label
        raise DataError(
            f"{without} has no logged commands, {other} has: gain and lag need the commands of "
            f"every session; log the commands of {without} too, name their topic "
            "(--command-topic), or compare it with sessions without commands"
        )
    return bool(free)


def _align_motions(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession]
) -> tuple[list[ComparedSession], list[ComparedSession], Alignment, Mapping[str, str]]:
    """Align sessions without commands.

    Returns:
        Both sides with the estimates of their motions, what they have in common, and the joint
        that the phase lag of each is taken to.

    Raises:
        DataError: If a session has no periodic motion, or no joint moves in all of them.
    """
    motions: list[PeriodicMotion] = []
    for session in (*a, *b):
        if session.motion is None:
            raise DataError(
                f"{session.run.label} has no logged commands and no periodic motion, so there is "
                "nothing to compare; choose a part that is periodic (--start, --stop)"
            )
        motions.append(session.motion)
    for side, side_motions in (("A", motions[: len(a)]), ("B", motions[len(a) :])):
        _refuse_copies(
            [(motion.label, motion.oscillation.amplitudes) for motion in side_motions], side
        )
    common = common_motion(motions)
    sides = [
        replace(session, estimates={**session.estimates, **motion_estimates(motion, common)})
        for session, motion in zip((*a, *b), motions, strict=True)
    ]
    aligned = Alignment(common.names, dict(common.left_out), None)
    return sides[: len(a)], sides[len(a) :], aligned, common.before


def _at_one_command(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession]
) -> tuple[list[ComparedSession], list[ComparedSession]]:
    """Return both sides with the offsets of each joint at one command."""
    every = [*a, *b]
    moved = at_one_command(
        [session.estimates for session in every], [session.commands for session in every]
    )
    sides = [
        replace(session, estimates=estimates)
        for session, estimates in zip(every, moved, strict=True)
    ]
    return sides[: len(a)], sides[len(a) :]


def _partial(aligned: Alignment, how: str) -> str | None:
    parts: list[str] = []
    if aligned.left_out:
        left = "; ".join(f"{name}: {why}" for name, why in aligned.left_out.items())
        parts.append(f"only {len(aligned.names)} joints can be compared{how} ({left})")
    if aligned.gaits_differ is not None:
        parts.append(f"the gaits differ: {aligned.gaits_differ}")
    if aligned.commands_differ is not None:
        parts.append(aligned.commands_differ)
    return "; ".join(parts) or None


def _warn(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession], design: str, warn: Warn
) -> None:
    if design == "sessions":
        warn(
            "one session a side: the intervals cover the noise within each session, not how "
            "one run differs from the next; record several runs a side "
            "and give them with --a and --b"
        )
        inputs = [
            next(iter(session.analysis.provenance.inputs.values())) for session in (a[0], b[0])
        ]
        if inputs[0] == inputs[1]:
            warn("both files have the same content: one session is compared with itself")
    if design == "groups" and max(len(a), len(b)) < 4:
        warn(f"{len(a)} and {len(b)} runs: so few leave wide intervals; 6 a side are a good number")
    for side, sessions in (("A", a), ("B", b)):
        for session in sessions:
            for text in session.analysis.warnings:
                if text.startswith("not settled"):
                    warn(f"{side}, {session.run.label}: {text}")


def _waveforms(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession], names: Sequence[str], design: str
) -> tuple[Waveform, ...]:
    waveforms: list[Waveform] = []
    for name in names:
        if not all(name in session.cycles for session in (*a, *b)):
            continue
        sides = [[_by_first(session, name, names) for session in side] for side in (a, b)]
        first, second, difference = differ(sides[0], sides[1], design)
        half = difference.error * [t_factor(dof) for dof in difference.dof.tolist()]
        worst = int(np.argmax(np.abs(difference.value)))
        most = float(difference.value[worst])
        waveforms.append(
            Waveform(
                name=name,
                a_rad=tuple(first.value.tolist()),
                b_rad=tuple(second.value.tolist()),
                difference_rad=tuple(difference.value.tolist()),
                half_rad=tuple(half.tolist()),
                rms_rad=float(np.sqrt(np.mean(difference.value**2))),
                largest=Estimate(most, around(most, float(half[worst]))),
                largest_at_rad=float(phases_rad()[worst]),
            )
        )
    return tuple(waveforms)


def _by_first(session: ComparedSession, name: str, names: Sequence[str]) -> Quantities:
    """Turn a mean cycle to the phase of the first common joint of the same frequency."""
    if (motion := session.motion) is not None:
        return turned(
            session.cycles[name], motion.phase_rad(motion.names[0]) - motion.phase_rad(names[0])
        )
    run = session.run
    group = run.group[run.names.index(name)]
    members = [k for k, other in enumerate(run.group) if other == group]
    commands = run.command[[members[0], next(k for k in members if run.names[k] in names)]]
    return turned(session.cycles[name], float(np.angle(commands[0] / commands[1])))


def _provenance(
    a: Sequence[ComparedSession], b: Sequence[ComparedSession], choices: Choices
) -> Provenance:
    paths = [[session.analysis.session.path for session in side] for side in (a, b)]
    single = len(a) == len(b) == 1 and not choices.paired
    files = [*paths[0], *paths[1]] if single else ["--a", *paths[0], "--b", *paths[1]]
    words = [word for word in ("paired", "any_gait") if getattr(choices, word)]
    default, margins = Margins(), choices.margins
    if margins.gain != default.gain:
        words.append(f"margin-gain={margins.gain!r}")
    if margins.lag_rad != default.lag_rad:
        words.append(f"margin-lag-deg={float(np.degrees(margins.lag_rad))!r}")
    options = [f"--{word.replace('_', '-')}" for word in words]
    return Provenance(
        command=shlex.join(["undulog", "compare", *files, *options, *choices.session.arguments()]),
        versions=base_versions(),
        inputs={
            k: v for session in (*a, *b) for k, v in session.analysis.provenance.inputs.items()
        },
        options={
            **asdict(choices.session),
            "paired": choices.paired,
            "any_gait": choices.any_gait,
            "margins": asdict(choices.margins),
            "confidence": CONFIDENCE,
        },
    )
