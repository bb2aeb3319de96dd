"""Prepare an experiment for the page."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

from ...experiment.answer import kick_checks, sweep_checks
from ...experiment.sweep.coupling import NONLINEAR
from ...results import formats
from ...results.coupling import Coupling, LinearCoupling, LocalCoupling
from ...results.estimate import Estimate
from ...results.experiment import Experiment, Reversal
from ..text_experiment import by_sentence, method, reversal_detail
from .matrix import entries_of, matrix_picture
from .mirror import mirror_profile, profiles
from .oscillators import body_facts, entrainment_entries, modes_drawing
from .tables import Fact, digits
from .trials import Trial, experiment_trials

AGREE = 0.1
"""Largest relative difference of Z from torques and Z from the described servos that agree."""


def _sweep_facts(coupling: LinearCoupling) -> list[Fact]:
    """Return the key figures at the first tone."""
    tone = coupling.tones[0]
    tones = ", ".join(f"{one.frequency_hz:.4g}" for one in coupling.tones)
    contact = {True: "in contact", False: "without contact", None: "contact unknown"}
    what = "X" if tone.Z is None else "Z"
    at = f"{what} at {tone.frequency_hz:.4g} Hz"
    of = f"of the off-diagonal energy of {at}"
    number = tone.inverted_condition if tone.Z is not None else tone.condition_number
    condition = "singular" if number is None else f"{number:.3g}"
    name = "Tone" if len(coupling.tones) == 1 else "Tones"
    return [
        Fact(name, f"{tones} Hz", contact[coupling.contact]),
        Fact("Asymmetry", formats.percent(tone.asymmetry), f"of {at}; 0 is reciprocal"),
        Fact("Between neighbours", formats.percent(tone.within_1), of),
        Fact("Within two joints", formats.percent(tone.within_2), of),
        Fact("Within three joints", formats.percent(tone.within_3), of),
        Fact("Condition number", condition, "of what is inverted; the errors grow by it"),
    ]


def _sweep_trials(coupling: LinearCoupling) -> list[Trial]:
    """Return the conditions for the matrices to be meaningful."""
    drift = coupling.drift_per_cycle
    settled = "no drift beyond noise" if drift == 0 else f"drift {digits(100 * drift)} % a cycle"
    trials = [
        Trial("Is every run settled?", settled, None, "no: settle longer" if drift else "yes"),
        _linear(coupling),
    ]
    for tone in coupling.tones:
        at = f"at {tone.frequency_hz:.4g} Hz"
        if tone.asymmetry.ci95 is not None:
            question = f"Does every pair of joints act on one another alike, {at}?"
            verdict = "no" if tone.asymmetry.ci95[0] > 0 else "a difference could not be shown"
            asymmetry = f"asymmetry {formats.percent(tone.asymmetry)}"
            trials.append(Trial(question, asymmetry, None, verdict))
        apart = tone.servo_difference
        if apart is not None:
            question = f"Do the described servos fit the torques, {at}?"
            verdict = f"{'yes' if apart <= AGREE else 'no'}, {100 * AGREE:g} % is taken as one"
            trials.append(Trial(question, f"Z differs by {digits(100 * apart)} %", None, verdict))
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


def experiment_view(experiment: Experiment) -> dict[str, Any]:
    """Return what the template shows of an experiment, by name."""
    reversal, coupling, body = experiment.reversal, experiment.coupling, experiment.oscillators
    joints = [joint for one in experiment.sessions for joint in one.joints]
    known = {joint.name for joint in joints if joint.gain.value is not None}
    names = tuple(name for name in dict.fromkeys(j.name for j in joints) if name in known)
    entries = entries_of(coupling, names)
    trials = experiment_trials(experiment)
    mirror = None
    if reversal is not None:
        mirror = mirror_profile(profiles(experiment, reversal), reversal, "mirror-figure")
    if isinstance(coupling, LinearCoupling):
        trials += _sweep_trials(coupling)
    return {
        "experiment": experiment,
        "runs": list(zip(experiment.runs, experiment.sessions, strict=True)),
        "left_out": [run for run in experiment.runs if run.role is None],
        "sentence": formats.sentence(experiment.answer),
        "detail": [] if reversal is None else list(reversal_detail(reversal)),
        "facts": _facts(experiment),
        "answers": [one.answer.sentence for one in experiment.sessions],
        "mirror": mirror,
        "entries": entries,
        "matrices": [
            matrix_picture(one, f"matrix-{k + 1}", small=k > 0) for k, one in enumerate(entries)
        ],
        "told": _checks(coupling),
        "modes": None if body is None else modes_drawing(body, "modes-figure"),
        "body_facts": [] if body is None else body_facts(body),
        "entrainment": None if body is None else entrainment_entries(body),
        "trials": trials,
        "indices": any(one.value is not None for one in experiment.heterogeneity.values()),
        "shared": _alike(by_sentence(experiment, "warnings")),
        "notes": [f"{note} ({files})" for note, files in _alike(by_sentence(experiment, "notes"))],
        "flagged": _flagged(experiment),
        "names": names,
        "tables": _tables(experiment, names),
        "method": formats.sentence(method(experiment)),
    }


def _checks(coupling: Coupling) -> list[str]:
    if isinstance(coupling, LocalCoupling):
        return list(kick_checks(coupling))
    return list(sweep_checks(coupling)) if isinstance(coupling, LinearCoupling) else []


def _tables(experiment: Experiment, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return gain and lag of every joint, one row a run."""
    if not names:
        return []
    runs = [{joint.name: joint for joint in one.joints} for one in experiment.sessions]
    rows = [[joints.get(name) for name in names] for joints in runs]
    gains = [[j and j.gain.value for j in row] for row in rows]
    lags = [[j and formats.degrees(j.lag_rad).value for j in row] for row in rows]
    return [
        {"title": "gain [1]", "decimals": 3, "rows": gains},
        {"title": "lag [°]", "decimals": 2, "rows": lags},
    ]


def _alike(warnings: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return one warning of those that differ in their numbers only."""
    found: dict[str, list[tuple[str, str]]] = {}
    for warning, files in warnings:
        found.setdefault(_NUMBERS.sub("#", warning), []).append((warning, files))
    result: list[tuple[str, str]] = []
    for (first, files), *more in found.values():
        times = "once" if len(more) == 1 else f"{len(more)} times"
        rest = f"; alike, with other numbers, {times} more" if more else ""
        result.append((first, files + rest))
    return result


def _flagged(experiment: Experiment) -> list[tuple[str, str]]:
    """Return joint and flag with the names of the files that have it."""
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
    counts = ", ".join(f"{count} {word}" for word, count in roles.items())
    facts = [Fact("Sessions", str(len(runs)), counts)]
    frequencies = [v for s in experiment.sessions if (v := s.gait.frequency_hz.value) is not None]
    if frequencies and not isinstance(experiment.coupling, LinearCoupling):
        low, high = (formats.number(v, 3) for v in (min(frequencies), max(frequencies)))
        facts.append(Fact("Gait frequency", f"{low} Hz" if low == high else f"{low} to {high} Hz"))
    if experiment.reversal is not None:
        facts += _reversal_facts(experiment.reversal)
    coupling = experiment.coupling
    if isinstance(coupling, LinearCoupling):
        facts += _sweep_facts(coupling)
    if isinstance(coupling, LocalCoupling):
        facts += _kick_facts(coupling)
    return facts


def _reversal_facts(reversal: Reversal) -> list[Fact]:
    floor = f"the least these runs can give: {formats.number(reversal.p_floor, 4)}"
    modules, boundary = map(formats.percent, (reversal.module_share, reversal.boundary_share))
    lag_bound = math.degrees(reversal.lag_bound_rad)
    return [
        Fact("p of identical modules", formats.p_value(reversal.p), floor),
        Fact("Modules' share", modules, "of the spread over the joints"),
        Fact("Boundary's share", boundary, "of the spread, the rest"),
        Fact("Gain bound", f"{formats.number(100 * reversal.gain_bound, 2)} %", _BOUND),
        Fact("Lag bound", f"{formats.number(lag_bound, 2)}°", _BOUND),
    ]


def _kick_facts(coupling: LocalCoupling) -> list[Fact]:
    valid = formats.estimate(Estimate(coupling.valid_to), " rad")
    nonlinearity, lti = coupling.nonlinearity, coupling.lti
    return [
        Fact("Nonlinearity", formats.percent(nonlinearity), "0 is linear, time-invariant"),
        Fact("Asymmetry of X", formats.percent(lti.asymmetry), "read as linear; 0 reciprocal"),
        Fact("Within one joint", formats.percent(lti.within_1), "of X's off-diagonal energy"),
        Fact("Valid to", valid, f"{len(coupling.held_out)} held-out runs"),
    ]
