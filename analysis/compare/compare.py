"""Compare two sessions, or two groups of them, joint by joint.

They can be compared where the same commands drove the same joints, and by their motion where no
session has commands.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.common.extras import base_versions

from ..common.estimate import Estimate, Provenance
from ..estimators.intervals import CONFIDENCE, around, t_factor
from ..results.comparison import Comparison, Waveform
from ..signals.stretch import Options
from .alignment import Alignment, align_commanded, refuse_copies
from .broken_joints import broken_joints
from .decisions import DIFFERS, MOVED, Margins, decide, differ, estimates_of, family
from .quantities import PeriodicMotion, Quantities, common_motion, motion_estimates
from .side import ComparedSession, changes, one_robot, phases_rad, see, turned
from .tracking import at_one_command, fastest_rad_s
from .words import answer_of, moved_offsets


@dataclass(frozen=True)
class Choices:
    """Options of a comparison.

    Example::

        choices = undulog.Choices(any_gait=True)
        result = undulog.compare("run.mcap", "again.mcap", choices=choices)

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
        refuse_copies(
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
