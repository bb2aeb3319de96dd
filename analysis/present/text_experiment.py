"""Write experiments and comparisons as text for a terminal, the answer first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from undulog.capture.common.console import UNLIMITED, plain

from ..common import formats
from ..common.estimate import Estimate
from ..common.formats import scaled
from ..compare.decisions import SIGNIFICANT_DIFFERENCE, WORDS
from ..compare.words import margin_text
from ..experiment.answer import kick_detail, sweep_detail, sweep_method
from ..experiment.best_linear import multisine_method
from ..experiment.body_connection import CONNECTION_METHOD, connection_detail
from ..experiment.reversal import SIGNIFICANT
from ..parts.shown import Column, Table, typical
from ..results.best_linear import BestLinearJoint
from ..results.body_connection import BodyConnection, PredictedTravel
from ..results.comparison import Comparison, MetadataChange
from ..results.coupling import LinearCoupling, LocalCoupling
from ..results.experiment import Experiment, FloorTilt, Headings, Reversal
from .tables import difference_table, mirror_table, run_table, waveform_table
from .text import Sheet, body_detail, unidentified

MOST_CHANGES = 12
"""Lines of what was changed; the rest is in the JSON."""

_DESIGNS = {
    "sessions": "one session a side, errors from each session's own noise (Welch-Satterthwaite)",
    "groups": "independent runs, errors from their scatter (Welch)",
    "pairs": "paired runs, errors from the scatter of their differences",
}

_MANY_TONES = ("no gait:", "no body motion", "no joint's gain and lag are known")
"""Beginnings of warnings that every run of a multisine has, since it is no gait."""


def best_linear_table(joints: Sequence[BestLinearJoint]) -> Table[BestLinearJoint]:
    """Return best linear approximations in short: band, bandwidth, delay, noise, distortion."""

    def noise(joint: BestLinearJoint) -> Estimate:
        gain = math.hypot(*joint.response.gain)
        measurable = joint.noise_sd is not None and gain > 0
        return Estimate(100 * math.hypot(*joint.noise_sd or ()) / gain if measurable else None)

    def share(name: str, spare: int = 0) -> Column[BestLinearJoint]:
        def percent(joint: BestLinearJoint) -> Estimate:
            return scaled(getattr(joint, name), 100.0)

        return Column(f"{name} % (95 %)", f"{name} [%]", percent, typical(2, 3), spare=spare)

    def lowest(joint: BestLinearJoint) -> Estimate:
        return Estimate(joint.response.gain[0], joint.response.gain_ci95[0])

    def delay_ms(joint: BestLinearJoint) -> Estimate:
        return scaled(joint.response.delay_s, 1e3)

    columns: list[Column[BestLinearJoint]] = [
        Column("joint", "joint", lambda joint: joint.response.joint, kind="word"),
        Column(
            "from Hz", "from [Hz]", lambda joint: joint.response.frequency_hz[0], (3, 4), spare=6
        ),
        Column("to Hz", "to [Hz]", lambda joint: joint.response.frequency_hz[-1], (2, 3), spare=6),
        Column("gain there (95 %)", "gain at the lowest [1]", lowest, typical(4, 4), spare=1),
        Column(
            "-3 dB Hz", "-3 dB [Hz]", lambda joint: Estimate(joint.response.bandwidth_hz), (2, 3)
        ),
        Column("delay ms (95 %)", "delay [ms]", delay_ms, typical(2, 3), spare=2),
        Column("noise %", "noise [%]", noise, (2, 3), spare=3),
        share("distortion"),
        share("odd", spare=5),
        share("even", spare=4),
    ]
    about = {
        "delay [ms]": "with the offset of the clocks",
        "noise [%]": "of the mean response",
        "distortion [%]": "nonlinear, over the gain, root mean squares over the lines; a dash "
        "where it can't be separated from noise",
        "odd [%]": "response at odd lines that the command leaves out, over that at its own",
        "even [%]": "the same at even lines",
    }
    return Table(columns, joints, about=about)


def render_comparison(
    comparison: Comparison, *, width: int = UNLIMITED, color: bool = False
) -> str:
    """Return a comparison as text; see :func:`.text.render`."""
    sheet = Sheet(width, color=color)
    sheet.print(f"{comparison.answer}.", "bold")
    for side, sessions in (("A", comparison.a), ("B", comparison.b)):
        names = ", ".join(plain(Path(session.path).name) for session in sessions)
        sheet.print(f"{side}: {names}")
    if comparison.partial is not None:
        sheet.print(f"Partial: {comparison.partial}")
    sheet.print()
    sheet.lines(_changed(comparison.changed))
    sheet.table(difference_table(comparison))
    if comparison.waveforms:
        sheet.table(waveform_table(comparison))
    sheet.print()
    sheet.print(_equivalence(comparison))
    sheet.lines(f"Warning: {plain(warning)}" for warning in comparison.warnings)
    sheet.print(f"Method: {comparison_method(comparison)}", "dim")
    return sheet.text()


def _changed(changed: tuple[MetadataChange, ...]) -> list[str]:
    if not changed:
        return ["What was changed: not recorded; the recorded facts are the same."]
    lines = ["What was changed (A, then B):"]
    for change in changed[:MOST_CHANGES]:
        a, b = ("not set" if side is None else formats.short(side) for side in (change.a, change.b))
        lines.append(f"  {plain(change.name)}: {a} -> {b}")
    rest = len(changed) - MOST_CHANGES
    return [*lines, f"  and {rest} more (--json)"] if rest > 0 else lines


def _equivalence(comparison: Comparison) -> str:
    parts: list[str] = []
    for test in comparison.equivalence:
        shown = "yes" if test.p < SIGNIFICANT_DIFFERENCE else "not shown"
        parts.append(
            f"{WORDS[test.quantity]} within {margin_text(test)} {shown} "
            f"(p {formats.p_value(test.p)})"
        )
    return f"The same within margins: {'; '.join(parts)}."


def comparison_method(comparison: Comparison) -> str:
    """Return the method of a comparison as one sentence, beginning in lower case."""
    phase = "gait phase" if comparison.commanded else "the phase of the first joint's own motion"
    aligned = f"aligned by {phase}" if comparison.waveforms else "each joint against its command"
    return (
        f"{aligned}; {_DESIGNS[comparison.design]}; decisions over all "
        f"{len(comparison.differences)} quantities after Holm at "
        f"{100 * SIGNIFICANT_DIFFERENCE:g} %, "
        "intervals hold together at 95 % after Bonferroni; the same within margins: two one-sided "
        "tests (TOST), each claim by itself at 5 %."
    )


def render_experiment(
    experiment: Experiment, *, width: int = UNLIMITED, color: bool = False
) -> str:
    """Return an experiment as text; see :func:`.text.render`."""
    sheet = Sheet(width, color=color)
    count = len(experiment.sessions)
    sheet.print(f"{count} session{'s' if count > 1 else ''}: {experiment.answer}.", "bold")
    reversal = experiment.reversal
    if reversal is not None:
        sheet.lines(reversal_detail(reversal))
        sheet.table(mirror_table(reversal))
    if isinstance(experiment.coupling, LocalCoupling):
        sheet.lines(kick_detail(experiment.coupling))
    if experiment.oscillators is not None:
        sheet.lines(body_detail(experiment.oscillators))
    if isinstance(experiment.coupling, LinearCoupling):
        sheet.lines(sweep_detail(experiment.coupling))
    if experiment.best_linear is not None:
        sheet.table(best_linear_table(experiment.best_linear.joints))
    body = experiment.body_connection
    if body is not None and body.fitted:
        sheet.lines(connection_detail(body))
        sheet.table(travel_table(body))
        sheet.lines(refusals(body))
    sheet.table(run_table(experiment))
    sheet.print()
    warnings = [f"{warning} ({names})" for warning, names in by_sentence(experiment, "warnings")]
    sheet.lines(f"Warning: {warning}" for warning in (*experiment.warnings, *warnings))
    fitted = body is not None and body.fitted
    if not experiment.coupling.identifiable and experiment.best_linear is None and not fitted:
        sheet.print(unidentified(experiment.coupling))
    if body is not None and not fitted and experiment.reversal is None:
        sheet.print(f"How shape moves the body: not identifiable: {body.why}.")
    sheet.print(f"Method: {method(experiment)}", "dim")
    notes = by_sentence(experiment, "notes")
    sheet.lines((f"Note: {note} ({names})" for note, names in notes), "dim")
    return sheet.text()


def reversal_detail(reversal: Reversal) -> Iterable[str]:
    """Yield sentences on the pairs, the tilt of the floor and the shares of the spread."""
    for pair in reversal.pairs:
        yield (
            f"{pair.name} against its mirror {pair.mirror}, over both directions: "
            f"{_gain(pair.log_gain_contrast)} in gain, {_lag(pair.lag_contrast_rad)} in lag "
            f"({formats.p_value_text(pair.p)}, ordered by {pair.by})."
        )
    if reversal.pairs:
        first = reversal.pairs[0]
        yield (
            f"Which of the two differs, the contrast can't decide: swap {first.name} for another "
            "module and record again, or compare one direction with a model (--null)."
        )
    if reversal.p < SIGNIFICANT:
        yield _tilt(reversal.tilt, reversal.middle)
    shares = (reversal.module_share, reversal.boundary_share)
    if shares[0].value is not None:
        yield (
            f"Spread over the joints: modules {formats.percent(shares[0])}, "
            f"boundary {formats.percent(shares[1])}."
        )
    if max(reversal.equivalence_gain_p, reversal.equivalence_lag_p) < SIGNIFICANT:
        yield "Shown to be alike: every mirror pair within 2 % and 1°."
    yield f"The test is {reversal.blind}."


def _tilt(tilt: FloorTilt, middle: str | None) -> str:
    """Return the evidence for and against a tilted floor."""
    lean = ""
    if tilt.gravity_rad.value is not None:
        fall = formats.estimate(formats.degrees(tilt.gravity_rad), "°", most=2)
        lean = f" Recorded gravity: the floor falls by {fall} along the body."
    if tilt.headings is Headings.BALANCED:
        return f"A tilted floor cancels: {tilt.strata} sets of mirror-image runs.{lean}"
    checks = f"the common part is {formats.estimate(tilt.ratio, most=2)} of the contrast"
    if middle is not None:
        middle_size = "any size" if tilt.middle is None else formats.number(tilt.middle, 2)
        checks += f", the middle joint {middle} at most {middle_size} of the largest contrast"
    verdict = "excluded" if tilt.excluded else "not excluded"
    return f"A tilted floor is {verdict}: {checks} (a tilt makes both large).{lean}"


def _gain(log_gain: Estimate) -> str:
    return formats.estimate(formats.relative(log_gain), " %", most=2)


def _lag(lag_rad: Estimate) -> str:
    return formats.estimate(formats.degrees(lag_rad), "°", most=2)


def by_sentence(
    experiment: Experiment, kind: Literal["warnings", "notes"]
) -> list[tuple[str, str]]:
    """Return the sessions' own warnings or notes, each once.

    Sentences on what the experiment itself answers are left out.

    Returns:
        Sentence, and the names of its files, or ``all sessions``.
    """
    expected = ["boundary or module:"]
    coupling = experiment.coupling
    several_tones = isinstance(coupling, LinearCoupling) and coupling.plan == "multisine"
    if several_tones or experiment.best_linear is not None:
        expected += _MANY_TONES
    files: dict[str, list[str]] = {}
    for session in experiment.sessions:
        for sentence in getattr(session, kind):
            if not sentence.startswith(tuple(expected)):
                files.setdefault(sentence, []).append(Path(session.session.path).name)
    everyone = len(experiment.sessions)
    return [
        (sentence, "all sessions" if len(names) == everyone else ", ".join(names))
        for sentence, names in files.items()
    ]


def method(experiment: Experiment) -> str:
    """Return the method of an experiment as one sentence, beginning in lower case."""
    coupling, body = experiment.coupling, experiment.body_connection
    if body is not None and body.fitted and experiment.reversal is None:
        return CONNECTION_METHOD
    if experiment.best_linear is not None:
        return multisine_method(experiment.best_linear)
    if isinstance(coupling, LocalCoupling):
        return _kick_method(coupling)
    if isinstance(coupling, LinearCoupling):
        return sweep_method(coupling)
    return _reversal_method(experiment.reversal)


def _kick_method(coupling: LocalCoupling) -> str:
    return (
        f"local kicks, {coupling.kicked_runs} runs around {coupling.base_runs} without a "
        "kick: central differences of each joint's phase and log amplitude, intervals at 95 % from "
        "the noise within runs and the scatter between them (Student's t), that of the largest "
        "coupling of all together, those of indices at least 95 %; all four matrices with --json."
    )


def _reversal_method(reversal: Reversal | None) -> str:
    if reversal is None:
        return "each session by itself as undulog analyse gives it; nothing is pooled."
    tried = (
        f"all {reversal.labellings}"
        if reversal.labellings_tried == reversal.labellings
        else f"{reversal.labellings_tried} random ones of {reversal.labellings}"
    )
    within = " within each set of mirror-image runs" if reversal.tilt.strata > 1 else ""
    return (
        f"reversal, {reversal.forward_runs} + {reversal.reverse_runs} runs: each joint "
        "with the wave from head to tail minus its mirror joint with the wave from tail to head; "
        "largest studentised contrast or common part of a pair T = "
        f"{formats.number(reversal.statistic, 2)}, its null by "
        f"dealing out the runs' labels anew{within} ({tried}; p can't go below "
        f"{formats.number(reversal.p_floor, 4)}), family-wise over pairs, gain and lag, so that "
        "5 % is the level of the whole answer; intervals hold together at 95 %, those of shares by "
        "bootstrap over runs."
    )


def travel_table(connection: BodyConnection) -> Table[PredictedTravel]:
    """Return the travel of each session, predicted from the others and measured."""

    def column(
        name: str, unit: str, of: Callable[[PredictedTravel], Estimate], spare: int = 0
    ) -> Column[PredictedTravel]:
        most = 1 if unit == "mm" else 2  # what a camera tells apart
        return Column(
            f"{name} {unit} (95 %)", f"{name} [{unit}]", of, typical(most, most), spare=spare
        )

    def mm(of: Callable[[PredictedTravel], Estimate]) -> Callable[[PredictedTravel], Estimate]:
        return lambda travel: formats.scaled(of(travel), 1000.0)

    columns: list[Column[PredictedTravel]] = [
        Column("session", "session", lambda travel: formats.filename(travel.path), kind="word"),
        Column("Hz", None, lambda travel: travel.frequency_hz, (3, 3), spare=3),
        column("forward", "mm", mm(lambda travel: travel.forward_m)),
        column("measured", "mm", mm(lambda travel: travel.measured_forward_m)),
        column("left", "mm", mm(lambda travel: travel.left_m), 2),
        column("measured left", "mm", mm(lambda travel: travel.measured_left_m), 2),
        column("turn", "°", lambda travel: formats.degrees(travel.turn_rad)),
        column("measured turn", "°", lambda travel: formats.degrees(travel.measured_turn_rad)),
    ]
    return Table(columns, connection.predicted)


def refusals(connection: BodyConnection) -> Iterator[str]:
    """Yield a sentence on each session that is not predicted."""
    for travel in connection.predicted:
        if travel.why is not None:
            yield f"{formats.filename(travel.path)} is not predicted: {travel.why}."
