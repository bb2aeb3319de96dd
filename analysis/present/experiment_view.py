"""Prepare an experiment for the page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.palette import joint_hex

from ..common import formats
from ..common.estimate import Estimate, leaves_out_zero
from ..common.formats import degrees, estimate, relative, short
from ..experiment.answer import kick_checks, sweep_checks
from ..experiment.body_connection import connection_detail
from ..experiment.sweep_coupling import NONLINEAR
from ..results.body_connection import BodyConnection
from ..results.coupling import Coupling, LinearCoupling, LocalCoupling
from ..results.experiment import Experiment, Reversal
from .bode import best_linear_bode
from .matrix import entries_of, matrix_picture
from .oscillators import body_facts, entrainment_entries, modes_drawing
from .page_tables import Fact, Trial, digits, experiment_trials
from .svg import (
    DASHED,
    INK,
    MUTED,
    REFERENCE,
    Axes,
    Drawing,
    drawing,
    inline_svg,
    joint_ticks,
    key,
    legend,
    plot_estimate,
)
from .text_experiment import (
    best_linear_table,
    by_sentence,
    method,
    refusals,
    reversal_detail,
    travel_table,
)

AGREE = 0.1
"""Largest relative difference of Z from torques and Z from the described servos that agree."""

_NUMBERS = re.compile(r"[-+]?\d[\d.e-]*")
_BOUND = "no joint differs more from its mirror, 95 %"

_ASIDE = 0.16
"""Distance of the dots of single runs from their joint's position."""

_SOLID: dict[str, Any] = {"markersize": 4.6, "markeredgecolor": INK, "markeredgewidth": 0.5}
_HOLLOW = _SOLID | {"markersize": 6.6, "markerfacecolor": "none", "markeredgewidth": 1.0}
_MIRRORED: dict[str, Any] = {"color": INK, "linestyle": (0, (2, 2))}


def _sweep_facts(coupling: LinearCoupling) -> list[Fact]:
    """Return the key figures at the first tone."""
    tone = coupling.tones[0]
    tones = ", ".join(f"{tone.frequency_hz:.4g}" for tone in coupling.tones)
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
    distortions = [tone.distortion for tone in coupling.tones if tone.distortion is not None]
    if not distortions:
        return Trial(question, "records too short for lines beside the tones", None, "open")
    worst = max(distortions)
    verdict = "yes" if worst <= NONLINEAR else "no: take a smaller amplitude"
    return Trial(question, f"largest distortion {digits(100 * worst)} %", None, verdict)


def experiment_view(experiment: Experiment) -> dict[str, Any]:
    """Return what the template shows of an experiment, by name."""
    reversal, coupling, body = experiment.reversal, experiment.coupling, experiment.oscillators
    best, connection = experiment.best_linear, experiment.body_connection
    connection = connection if connection is not None and connection.fitted else None
    joints = [joint for session in experiment.sessions for joint in session.joints]
    answered = {joint.name for joint in joints if joint.gain.value is not None}
    names = tuple(name for name in dict.fromkeys(j.name for j in joints) if name in answered)
    entries = entries_of(coupling, names)
    trials = experiment_trials(experiment)
    if isinstance(coupling, LinearCoupling):
        trials += _sweep_trials(coupling)
    return {
        "experiment": experiment,
        "runs": list(zip(experiment.runs, experiment.sessions, strict=True)),
        "left_out": [run for run in experiment.runs if run.role is None],
        "question": _question(experiment),
        "sentence": formats.sentence(experiment.answer),
        "detail": [] if reversal is None else list(reversal_detail(reversal)),
        "facts": _facts(experiment),
        "answers": [session.answer.sentence for session in experiment.sessions],
        "mirror": None
        if reversal is None
        else mirror_profile(profiles(experiment, reversal), reversal, "mirror-figure"),
        "bode": [] if best is None else best_linear_bode(best.joints, "bode-figure"),
        "responses": None if best is None else best_linear_table(best.joints),
        "entries": entries,
        "matrices": [
            matrix_picture(entry, f"matrix-{k + 1}", small=k > 0) for k, entry in enumerate(entries)
        ],
        "checks": _checks(coupling),
        "travel": None if connection is None else travel_table(connection),
        "travel_figure": None
        if connection is None or all(travel.why for travel in connection.predicted)
        else travel_drawing(connection),
        "travel_detail": [] if connection is None else connection_detail(connection),
        "travel_refusals": [] if connection is None else list(refusals(connection)),
        "modes": None if body is None else modes_drawing(body),
        "body_facts": [] if body is None else body_facts(body),
        "entrainment": None if body is None else entrainment_entries(body),
        "trials": trials,
        "indices": any(index.value is not None for index in experiment.heterogeneity.values()),
        "shared": _alike(by_sentence(experiment, "warnings")),
        "notes": [f"{note} ({files})" for note, files in _alike(by_sentence(experiment, "notes"))],
        "flagged": _flagged(experiment),
        "names": names,
        "tables": _tables(experiment, names),
        "method": formats.sentence(method(experiment)),
    }


def _question(experiment: Experiment) -> str:
    """Return the question that the answer of an experiment answers."""
    if experiment.best_linear is not None:
        return "How does each joint respond to its command, from frequency to frequency?"
    if experiment.reversal is not None:
        return "Does the spread over the joints come from the modules or from the boundary?"
    if experiment.coupling.identifiable:
        return "How does the motion of one joint act on the others?"
    body = experiment.body_connection
    if body is not None and body.fitted:
        return "How do changes of shape move the body?"
    return "What can these sessions separate: modules, boundary, coupling between joints?"


def _checks(coupling: Coupling) -> list[str]:
    if isinstance(coupling, LocalCoupling):
        return list(kick_checks(coupling))
    return list(sweep_checks(coupling)) if isinstance(coupling, LinearCoupling) else []


def _tables(experiment: Experiment, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return gain and lag of every joint, one row a run."""
    if not names:
        return []
    runs = [{joint.name: joint for joint in session.joints} for session in experiment.sessions]
    rows = [[joints.get(name) for name in names] for joints in runs]
    gains = [[j and j.gain.value for j in row] for row in rows]
    lags = [[j and formats.degrees(j.lag_rad).value for j in row] for row in rows]
    return [
        {"title": "gain [1]", "decimals": 3, "rows": gains},
        {"title": "lag [°]", "decimals": 2, "rows": lags},
    ]


def _alike(warnings: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return one warning of those that differ in their numbers only."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for warning, files in warnings:
        groups.setdefault(_NUMBERS.sub("#", warning), []).append((warning, files))
    result: list[tuple[str, str]] = []
    for (first, files), *more in groups.values():
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
    roles = Counter(run.role or "left out" for run in runs)
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


class Profiles(NamedTuple):
    """Gain and lag of the runs of a reversal, all read at the joints of the forward wave.

    Attributes:
        gain: Of the r1 runs from head to tail, shape (r1, m).
        lag_deg: Their lag [deg], within 180 of the joint's mean, shape (r1, m).
        mirrored_gain: Of the r2 runs from tail to head, read from tail to head, shape (r2, m).
        mirrored_lag_deg: Their lag [deg], shape (r2, m).
    """

    gain: FloatArray
    lag_deg: FloatArray
    mirrored_gain: FloatArray
    mirrored_lag_deg: FloatArray


def profiles(experiment: Experiment, reversal: Reversal) -> Profiles:
    """Return gain and lag of the joints that take part in a reversal test, run by run."""
    names = [joint.name for joint in reversal.joints]

    def of(role: str) -> tuple[FloatArray, FloatArray]:
        chosen = [
            {joint.name: joint for joint in session.joints}
            for run, session in zip(experiment.runs, experiment.sessions, strict=True)
            if run.role == role
        ]
        gain = [[joints[name].gain.value for name in names] for joints in chosen]
        lag = [[joints[name].lag_rad.value for name in names] for joints in chosen]
        return np.array(gain, dtype=np.float64), np.array(lag, dtype=np.float64)

    (gain, lag), (back_gain, back_lag) = of("forward"), of("reverse")
    middle = np.angle(np.nanmean(np.exp(1j * lag)))
    lag, back_lag = (
        middle + np.angle(np.exp(1j * (angles - middle))) for angles in (lag, back_lag)
    )
    parts = (gain, np.degrees(lag), back_gain[:, ::-1], np.degrees(back_lag)[:, ::-1])
    return Profiles(*map(frozen, parts))


def mirror_profile(seen: Profiles, reversal: Reversal, prefix: str) -> Drawing:
    """Draw gain and lag of both directions, each with its differences below.

    Args:
        prefix: For identifiers, unique in the page.
    """
    joints = reversal.joints
    colors = joint_hex(len(joints))
    tooltips: dict[str, str] = {}
    gains = [relative(joint.log_gain_difference) for joint in joints]
    lags = [degrees(joint.lag_difference_rad) for joint in joints]
    labels = ("gain [1]", "difference [%]", "lag [°]", "difference [°]")
    with drawing(6.6) as figure:
        rows = figure.subplots(4, 1, sharex=True, height_ratios=[1.35, 1, 1.35, 1])
        _profile(rows[0], seen.gain, seen.mirrored_gain, colors)
        _differences(rows[1], reversal, gains, colors, tooltips, what="gain")
        _profile(rows[2], seen.lag_deg, seen.mirrored_lag_deg, colors)
        _differences(rows[3], reversal, lags, colors, tooltips, what="lag")
        for axes, label in zip(rows, labels, strict=True):
            axes.set_ylabel(label)
        joint_ticks(rows[3], [joint.name for joint in joints])
        rows[3].set_xlabel("joint with the wave from head to tail, head on the left")
        figure.align_ylabels()
        middle = colors[len(colors) // 2]
        legend(
            figure,
            key(color=middle, marker="o", label="wave from head to tail", **_SOLID),
            key(marker="D", label="from tail to head, mirrored", **_MIRRORED, **_HOLLOW),
            key(color=MUTED, marker=".", linestyle="none", label="one run"),
            key(color=middle, linewidth=2.2, label="difference, 95 % together"),
        )
        title = "Gain and lag of both directions, and their differences"
        svg = inline_svg(figure, prefix, title, _mirror_in_words(reversal), tooltips)
    return Drawing(
        svg,
        "Identical modules mirror: the profile with the wave from tail to head, read from tail to "
        "head, lies on the other one, whatever the free ends do to both. The intervals of the "
        "differences hold all together at 95 %: a pair differs where its interval leaves out zero. "
        "The name of a weak module stands at its difference.",
    )


def _profile(axes: Axes, forward: FloatArray, other: FloatArray, colors: Sequence[str]) -> None:
    place: FloatArray = np.arange(1.0, forward.shape[1] + 1.0)
    for runs, aside in ((forward, -_ASIDE), (other, _ASIDE)):
        for run in runs:
            axes.plot(place + aside, run, ".", color=MUTED, markersize=2.2, zorder=2)
    axes.plot(place, other.mean(0), linewidth=1.0, **_MIRRORED)
    axes.plot(place, forward.mean(0), color=MUTED, linewidth=1.0, zorder=1)
    for x, y, color in zip(place, forward.mean(0), colors, strict=True):
        axes.plot([x], [y], "o", markerfacecolor=color, **_SOLID, zorder=3)
    # Hollow and larger, so that a diamond on a dot shows both.
    axes.plot(place, other.mean(0), "D", **_HOLLOW, zorder=4)


def _differences(
    axes: Axes,
    reversal: Reversal,
    values: Sequence[Estimate],
    colors: Sequence[str],
    tooltips: dict[str, str],
    *,
    what: str,
) -> None:
    named = {pair.name for pair in reversal.pairs}
    axes.axhline(0.0, color=REFERENCE, linestyle=DASHED, zorder=1)
    unit = " %" if what == "gain" else "°"
    for k, (joint, value, color) in enumerate(zip(reversal.joints, values, colors, strict=True)):
        if value.value is None or value.ci95 is None:
            continue
        size, edge = (5.2, 0.9) if leaves_out_zero(value.ci95) else (3.6, 0.4)
        style: dict[str, Any] = {"markersize": size, "markeredgewidth": edge}
        plot_estimate(axes, k + 1, value, color, bar=2.2, gid=f"{what}-{k}", **style)
        tooltips[f"{what}-{k}"] = (
            f"{joint.name} against {joint.mirror}: {what} {estimate(value, unit)}"
        )
        if joint.name in named:
            above = value.value > 0
            axes.annotate(
                short(joint.name, 14),
                (k + 1, value.ci95[1] if above else value.ci95[0]),
                xytext=(0, 5 if above else -5),
                textcoords="offset points",
                ha="center",
                va="bottom" if above else "top",
                fontweight="bold",
            )
    axes.margins(y=0.3)


def _mirror_in_words(reversal: Reversal) -> str:
    less = ", ".join(f"{pair.name} less than {pair.mirror}" for pair in reversal.pairs) or "none"
    return (
        f"{len(reversal.joints)} joints, {reversal.forward_runs} and {reversal.reverse_runs} runs. "
        f"Pairs that differ beyond doubt: {less}. The table of mirror pairs holds every number."
    )


def travel_drawing(connection: BodyConnection) -> Drawing:
    """Draw by how much the predicted travel of each session differs from the measured one."""
    panels = (
        ("forward", " mm", 1000.0, "forward_m"),
        ("left", " mm", 1000.0, "left_m"),
        ("turn", "°", math.degrees(1.0), "turn_rad"),
    )
    travels = [travel for travel in connection.predicted if travel.why is None]
    tooltips: dict[str, str] = {}
    with drawing(2.7) as figure:
        for axes, (name, unit, scale, field) in zip(figure.subplots(1, 3), panels, strict=True):
            axes.axhline(0.0, color=REFERENCE, linestyle=DASHED, zorder=1)
            for k, travel in enumerate(travels):
                measured = formats.scaled(getattr(travel, f"measured_{field}"), scale)
                predicted = formats.scaled(getattr(travel, field), scale)
                if measured.value is None or predicted.value is None:
                    continue
                low, high = predicted.ci95 or (math.nan, math.nan)
                seen = measured.value
                off = Estimate(predicted.value - seen, (low - seen, high - seen))
                plot_estimate(axes, seen, off, INK, gid=f"{name}-{k}")
                shown = formats.number(seen, formats.decimals_for([predicted]))
                tooltips[f"{name}-{k}"] = (
                    f"{formats.filename(travel.path)}: {name} predicted "
                    f"{estimate(predicted, unit)}, measured {shown}{unit}"
                )
            axes.set_xlabel(f"measured {name} [{unit.strip()}]")
            axes.set_ylabel(f"predicted \N{MINUS SIGN} measured [{unit.strip()}]")
            axes.margins(0.12)
        title = "Travel of a cycle, predicted from the other sessions, against the measured one"
        described = f"{len(travels)} sessions; the table below holds every number."
        svg = inline_svg(figure, "travel-figure", title, described, tooltips)
    return Drawing(
        svg,
        "Each dot is a session, predicted from its joint angles by a model of the others, with the "
        "95 % interval of the prediction: on the dashed line it is exact.",
    )
