"""What the page shows of several sessions of one experiment."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ...experiment.answer import kick_checks, sweep_checks
from ...experiment.sweep.coupling import NONLINEAR
from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.coupling import Coupling, LinearCoupling, LocalCoupling
from ...results.estimate import Estimate
from ...results.experiment import Experiment, Run
from ..text_experiment import by_note, by_warning, method, reversal_detail
from .matrix import Entries, entries_of, matrix_picture
from .mirror import mirror_profile, profiles
from .oscillators import body_facts, entrainment_entries, modes_drawing
from .svg import Drawing
from .tables import Fact, digits
from .trials import Trial, experiment_trials

AGREE = 0.1
"""Z by torques and Z behind the described servos are called one up to this relative difference."""


def sweep_facts(coupling: LinearCoupling) -> list[Fact]:
    """Key figures at the first tone."""
    tone = coupling.tones[0]
    tones = ", ".join(f"{one.frequency_hz:.4g}" for one in coupling.tones)
    at = f"{tone.frequency_hz:.4g} Hz"
    what = "X" if tone.Z is None else "Z"
    of = f"of the off-diagonal energy of {what} at {at}"
    inverted = tone.inverted_condition if tone.Z is not None else tone.condition_number
    return [
        Fact(
            "Tone" if len(coupling.tones) == 1 else "Tones",
            f"{tones} Hz",
            {True: "in contact", False: "without contact", None: "contact unknown"}[
                coupling.contact
            ],
        ),
        Fact("Asymmetry", formats.percent(tone.asymmetry), f"of {what} at {at}; 0 is reciprocal"),
        Fact("Between neighbours", formats.percent(tone.within_1), of),
        Fact("Within two joints", formats.percent(tone.within_2), of),
        Fact("Within three joints", formats.percent(tone.within_3), of),
        Fact(
            "Condition number",
            "singular" if inverted is None else f"{inverted:.3g}",
            "of what is inverted; the errors grow by it",
        ),
    ]


def sweep_trials(coupling: LinearCoupling) -> list[Trial]:
    """What must hold for the matrices to mean something."""
    drift = coupling.drift_per_cycle
    settled = "no drift beyond noise" if drift == 0 else f"drift {digits(100 * drift)} % a cycle"
    trials = [
        Trial("Is every run settled?", settled, None, "no: settle longer" if drift else "yes"),
        _linear(coupling),
    ]
    for tone in coupling.tones:
        at = f"at {tone.frequency_hz:.4g} Hz"
        if tone.asymmetry.ci95 is not None:
            trials.append(
                Trial(
                    f"Does every pair of joints act on one another alike, {at}?",
                    f"asymmetry {formats.percent(tone.asymmetry)}",
                    None,
                    "no" if tone.asymmetry.ci95[0] > 0 else "a difference could not be shown",
                )
            )
        apart = tone.servo_difference
        if apart is not None:
            trials.append(
                Trial(
                    f"Do the described servos fit the torques, {at}?",
                    f"Z differs by {digits(100 * apart)} %",
                    None,
                    f"{'yes' if apart <= AGREE else 'no'}, {100 * AGREE:g} % is taken as one",
                )
            )
    return trials


def _linear(coupling: LinearCoupling) -> Trial:
    question = f"Is the chain linear for these motions, within {100 * NONLINEAR:g} %?"
    known = [one.distortion for one in coupling.tones if one.distortion is not None]
    if not known:
        return Trial(question, "records too short for lines beside the tones", None, "open")
    worst = max(known)
    verdict = "yes" if worst <= NONLINEAR else "no: take a smaller amplitude"
    return Trial(question, f"largest distortion {digits(100 * worst)} %", None, verdict)


_NUMBERS = re.compile(r"[-+]?\d[\d.e-]*")
_BOUND = "no joint differs more from its mirror, 95 %"


@dataclass(frozen=True)
class RunsTable:
    """A quantity of every joint in every run.

    Attributes:
        title: What it is, with its unit.
        decimals: Digits after the point.
        rows: One a run: the values of all joints that any run knows.
    """

    title: str
    decimals: int
    rows: tuple[tuple[float | None, ...], ...]


@dataclass(frozen=True)
class ExperimentView:
    """All that the template shows of an experiment.

    Attributes:
        runs: Each session's part, and its numbers.
        left_out: Sessions that have no part in it.
        answers: What each session says by itself.
        mirror: Both directions, or None.
        entries: Coupling matrices, the main one first.
        told: What the coupling says besides, in sentences.
        modes: What oscillators that feel their servos would do, or None.
        entrainment: The other reading of P, or None.
        indices: Whether any heterogeneity index has a value.
        shared: Warnings of single sessions, alike ones once, with the files that have them.
        notes: Notes of single sessions, likewise.
        flagged: Flag of a joint, with the files that have it.
        names: Joints that any run has a gain of.
        tables: Gain and lag of them in every run.
    """

    experiment: Experiment
    runs: tuple[tuple[Run, Analysis], ...]
    left_out: tuple[Run, ...]
    sentence: str
    detail: tuple[str, ...]
    facts: tuple[Fact, ...]
    answers: tuple[str, ...]
    mirror: Drawing | None
    entries: tuple[Entries, ...]
    matrices: tuple[Drawing, ...]
    told: tuple[str, ...]
    modes: Drawing | None
    body_facts: tuple[Fact, ...]
    entrainment: Entries | None
    trials: tuple[Trial, ...]
    indices: bool
    shared: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    flagged: tuple[tuple[str, str], ...]
    names: tuple[str, ...]
    tables: tuple[RunsTable, ...]
    method: str


def experiment_view(experiment: Experiment) -> ExperimentView:
    """Prepare what the template shows of an experiment."""
    reversal, coupling, body = experiment.reversal, experiment.coupling, experiment.oscillators
    names = _known_joints(experiment)
    entries = entries_of(coupling, names)
    mirror = None
    if reversal is not None:
        mirror = mirror_profile(profiles(experiment, reversal), reversal, "mirror-figure")
    return ExperimentView(
        experiment=experiment,
        runs=tuple(zip(experiment.runs, experiment.sessions, strict=True)),
        left_out=tuple(run for run in experiment.runs if run.role is None),
        sentence=formats.sentence(experiment.answer),
        detail=tuple(reversal_detail(reversal)) if reversal is not None else (),
        facts=tuple(_facts(experiment)),
        answers=tuple(one.answer.sentence for one in experiment.sessions),
        mirror=mirror,
        entries=entries,
        matrices=tuple(
            matrix_picture(one, f"matrix-{k + 1}", small=k > 0) for k, one in enumerate(entries)
        ),
        told=_checks(coupling),
        modes=None if body is None else modes_drawing(body, "modes-figure"),
        body_facts=() if body is None else tuple(body_facts(body)),
        entrainment=None if body is None else entrainment_entries(body),
        trials=experiment_trials(experiment)
        + (tuple(sweep_trials(coupling)) if isinstance(coupling, LinearCoupling) else ()),
        indices=any(one.value is not None for one in experiment.heterogeneity.values()),
        shared=tuple(_alike(by_warning(experiment))),
        notes=tuple(f"{note} ({files})" for note, files in _alike(by_note(experiment))),
        flagged=tuple(_flagged(experiment)),
        names=names,
        tables=_tables(experiment, names),
        method=formats.sentence(method(experiment)),
    )


def _checks(coupling: Coupling) -> tuple[str, ...]:
    if isinstance(coupling, LocalCoupling):
        return tuple(kick_checks(coupling))
    return tuple(sweep_checks(coupling)) if isinstance(coupling, LinearCoupling) else ()


def _known_joints(experiment: Experiment) -> tuple[str, ...]:
    """Joints that have a gain in any session, in chain order."""
    order = dict.fromkeys(joint.name for one in experiment.sessions for joint in one.joints)
    known = {
        joint.name
        for one in experiment.sessions
        for joint in one.joints
        if joint.gain.value is not None
    }
    return tuple(name for name in order if name in known)


def _tables(experiment: Experiment, names: Sequence[str]) -> tuple[RunsTable, ...]:
    def rows(of: str) -> tuple[tuple[float | None, ...], ...]:
        result: list[tuple[float | None, ...]] = []
        for session in experiment.sessions:
            joints = {joint.name: joint for joint in session.joints}
            result.append(tuple(_value(joints.get(name), of) for name in names))
        return tuple(result)

    if not names:
        return ()
    return (RunsTable("gain [1]", 3, rows("gain")), RunsTable("lag [°]", 2, rows("lag")))


def _value(joint: JointResult | None, of: str) -> float | None:
    if joint is None:
        return None
    return joint.gain.value if of == "gain" else formats.degrees(joint.lag_rad).value


def _alike(warnings: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Warnings that differ by their numbers alone, once."""
    found: dict[str, list[tuple[str, str]]] = {}
    for warning, files in warnings:
        found.setdefault(_NUMBERS.sub("#", warning), []).append((warning, files))
    return [
        (
            first,
            files if not more else f"{files}; alike, with other numbers, {_times(len(more))} more",
        )
        for (first, files), *more in found.values()
    ]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _flagged(experiment: Experiment) -> list[tuple[str, str]]:
    """Joint and flag, with the files that show it."""
    seen: dict[str, list[str]] = {}
    for session in experiment.sessions:
        for joint in session.joints:
            for flag in joint.flags:
                seen.setdefault(f"{joint.name}: {flag}", []).append(
                    formats.filename(session.session.path)
                )
    everyone = len(experiment.sessions)
    return [
        (what, "all sessions" if len(files) == everyone else ", ".join(files))
        for what, files in seen.items()
    ]


def _facts(experiment: Experiment) -> list[Fact]:
    runs = experiment.runs
    roles: dict[str, int] = {}
    for run in runs:
        word = run.role or "left out"
        roles[word] = roles.get(word, 0) + 1
    told = ", ".join(f"{count} {word}" for word, count in roles.items())
    facts = [Fact("Sessions", str(len(runs)), told)]
    frequencies = [v for s in experiment.sessions if (v := s.gait.frequency_hz.value) is not None]
    if frequencies and not isinstance(experiment.coupling, LinearCoupling):
        low, high = (formats.number(v, 3) for v in (min(frequencies), max(frequencies)))
        facts.append(Fact("Gait frequency", f"{low} Hz" if low == high else f"{low} to {high} Hz"))
    reversal, coupling = experiment.reversal, experiment.coupling
    if reversal is not None:
        lag_bound = math.degrees(reversal.lag_bound_rad)
        facts += [
            Fact("p of identical modules", formats.p_value(reversal.p), _floor(reversal.p_floor)),
            Fact(
                "Modules' share",
                formats.percent(reversal.module_share),
                "of the spread over the joints",
            ),
            Fact(
                "Boundary's share",
                formats.percent(reversal.boundary_share),
                "of the spread, the rest",
            ),
            Fact("Gain bound", f"{formats.number(100 * reversal.gain_bound, 2)} %", _BOUND),
            Fact("Lag bound", f"{formats.number(lag_bound, 2)}°", _BOUND),
        ]
    if isinstance(coupling, LinearCoupling):
        facts += sweep_facts(coupling)
    if isinstance(coupling, LocalCoupling):
        valid = coupling.valid_to
        facts += [
            Fact(
                "Nonlinearity",
                formats.percent(coupling.nonlinearity),
                "0 is linear, time-invariant",
            ),
            Fact(
                "Asymmetry of X",
                formats.percent(coupling.lti.asymmetry),
                "read as linear; 0 reciprocal",
            ),
            Fact(
                "Within one joint",
                formats.percent(coupling.lti.within_1),
                "of X's off-diagonal energy",
            ),
            Fact(
                "Valid to",
                formats.estimate(Estimate(valid), " rad"),
                f"{len(coupling.held_out)} held-out runs",
            ),
        ]
    return facts


def _floor(p: float) -> str:
    return f"the least these runs can give: {formats.number(p, 4)}"
