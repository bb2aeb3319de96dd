"""The answer of an experiment in one sentence: boundary or module?"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from undulog.capture.judgement.naming import NAMED

from ..common import formats
from ..common.answer import Answer, NotFollowing
from ..common.estimate import Estimate, leaves_out_zero
from ..parts.comparison.words import fault_in_words
from ..results.analysis import Analysis
from ..results.coupling import (
    Coupling,
    LinearCoupling,
    LocalCoupling,
    Lti,
    Route,
    RowCheck,
    RunScatter,
    ToneCoupling,
)
from ..results.experiment import OrderedPair, Reversal
from ..session.runs import Role
from .pooling import PooledResponse
from .reversal import SIGNIFICANT

_ROUTES = {
    Route.TORQUE: "Z from torques",
    Route.SERVO: "Z from H and the servo's parameters",
    Route.ROW_SCALED: "H^-1, which is Z up to a factor for each row",
}


def kick_answer(coupling: Coupling) -> str:
    """Answer from the coupling.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not isinstance(coupling, LocalCoupling):
        return f"coupling not identifiable from these kicks: {coupling.why}"
    answer = "; ".join(part for part in (_largest(coupling), _linear(coupling)) if part)
    if not coupling.checks_pass:
        # First of all: nothing below holds as it would for a settled gait.
        answer = f"doubtful, since {_rows_that_fail(coupling)} as shifting time demands; {answer}"
    size = coupling.kick_size
    if size is not None and size.why is not None:
        answer = f"{answer}; {size.why}"
    return f"coupling around this gait: {answer}"


def _largest(coupling: LocalCoupling) -> str:
    """Describe the largest element of P off the diagonal that is significant.

    The largest of many is large by chance, too: its interval is that which holds for all elements
    off the diagonal together.
    """
    P = np.array(coupling.P.value)
    half = np.array(coupling.P.ci95_half_together or coupling.P.ci95_half)
    off = ~np.eye(len(P), dtype=bool)
    shown = off & (np.abs(P) > half)
    if not shown.any():
        most = formats.number(float((np.abs(P) + half)[off].max()), 2)
        return (
            "no joint is shown to follow the phase of another, and none does by more than "
            f"{most} (95 %, all pairs together)"
        )
    i, j = (int(k) for k in np.unravel_index(np.argmax(np.abs(P) * shown), P.shape))
    low, high = float(P[i, j] - half[i, j]), float(P[i, j] + half[i, j])
    return (
        f"{coupling.joints[i]} follows the phase of {coupling.joints[j]} most, by "
        f"{formats.estimate(Estimate(float(P[i, j]), (low, high)))}"
    )


def _linear(coupling: LocalCoupling) -> str | None:
    index = coupling.nonlinearity
    if index.value is None:
        return None
    if leaves_out_zero(index.ci95):
        return f"nonlinearity {formats.percent(index)}"
    if index.ci95 is None:
        return "whether it is linear is open"
    end = 100 * index.ci95[1]
    most = formats.number(end, formats.decimals_for_values([end], 2))
    return f"no nonlinearity is shown (at most {most} %)"


def _rows_that_fail(coupling: LocalCoupling) -> str:
    off = {
        f"rows of {symbol} don't sum to {total}": max(
            _off(row) / max(row.standard_error, 1e-12) for row in rows
        )
        for symbol, total, rows in (("P", 1, coupling.phase_rows), ("R", 0, coupling.gain_rows))
    }
    return max(off, key=lambda text: off[text])


def kick_detail(coupling: LocalCoupling) -> Iterable[str]:
    """Yield the sentences that follow the answer."""
    yield from kick_checks(coupling)
    for prediction in coupling.held_out:
        yield (
            f"Held out, {prediction.session}: deviations up to {prediction.size:.3f}, error "
            f"{100 * prediction.error:.2f} % (noise {100 * prediction.noise:.2f} %), "
            f"'each joint keeps its response' {100 * prediction.error_kept:.2f} %."
        )
    if coupling.valid_to is not None:
        yield f"Valid for deviations up to {coupling.valid_to:.3f} rad, as far as was tried."
    size = coupling.kick_size
    if size is not None:
        yield (
            f"Kicks of {size.phase_rad:.2g} rad show couplings of {size.resolved:.2g} and more; "
            f"what they do is {100 * size.curvature:.2g} % of second order: {size.verdict}."
        )


def kick_checks(coupling: LocalCoupling) -> Iterable[str]:
    """Yield the results of the checks, and of the reading as a linear chain."""
    verdict = "pass" if coupling.checks_pass else "FAIL"
    yield (
        f"Time shift: rows of P sum to 1 within {_worst(coupling.phase_rows)}, rows of R to 0 "
        f"within {_worst(coupling.gain_rows)}: {verdict}."
    )
    if coupling.scatter is not None:
        yield _scatter(coupling.scatter)
    lti = coupling.lti
    if lti.asymmetry.value is not None:
        bands = _bands(lti, " joint", " joints")
        yield (
            "Read as a linear time-invariant chain, which it is not unless the nonlinearity is "
            f"small: X = H^-1 (condition number {coupling.condition_number:.3g}) has asymmetry "
            f"{formats.percent(lti.asymmetry)}; off-diagonal energy {bands}."
        )


def _bands(model: Lti | ToneCoupling, joint: str = "", joints: str = "") -> str:
    """Return the shares of the off-diagonal energy within one, two and three joints."""
    shares = zip(
        (model.within_1, model.within_2, model.within_3), (joint, joints, joints), strict=True
    )
    return ", ".join(
        f"{formats.percent(share)} within {k}{word}" for k, (share, word) in enumerate(shares, 1)
    )


def _scatter(scatter: RunScatter) -> str:
    """Describe how much runs differ, in degrees and percent."""
    phase, gain = (np.array(values) for values in (scatter.phase_rad, scatter.log_gain))
    noise = np.degrees(np.median(scatter.phase_noise_rad))
    widened = "" if scatter.widened <= 1 else f"; errors widened by up to {scatter.widened:.2g}"
    return (
        f"Runs differ by {np.degrees(np.median(phase)):.2g}° (median of the joints, at most "
        f"{np.degrees(phase.max()):.2g}°) and {100 * np.median(gain):.2g} % beyond the noise "
        f"within them ({noise:.2g}°), with {scatter.dof} degrees of freedom; all intervals have "
        f"it{widened}."
    )


def _off(row: RowCheck) -> float:
    return abs((row.total.value or 0.0) - row.expected)


def _worst(rows: tuple[RowCheck, ...]) -> str:
    """Return the largest deviation of a row's sum, with its standard error."""
    worst = max(rows, key=_off)
    off = _off(worst)
    digits = 1 - math.floor(math.log10(max(off, worst.standard_error, 1e-6)))
    return f"{off:.{digits}f} ({worst.name}, standard error {worst.standard_error:.{digits}f})"


def sweep_answer(coupling: Coupling) -> str:
    """Answer from the coupling.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not isinstance(coupling, LinearCoupling):
        return f"coupling not identifiable from these runs: {coupling.why}"
    first = coupling.tones[0]
    where = {True: " in contact", False: " without contact", None: ""}[coupling.contact]
    answer = f"coupling{where} at {first.frequency_hz:.4g} Hz"
    if first.asymmetry.value is None:
        return f"{answer}: H can't be inverted"
    return (
        f"{answer}: {formats.percent(first.within_1)} of it is between neighbours, "
        f"{formats.percent(first.within_2)} within two joints; "
        f"asymmetry {formats.percent(first.asymmetry)} ({_ROUTES[first.route]})"
    )


def sweep_detail(coupling: LinearCoupling) -> Iterable[str]:
    """Yield the sentences that follow the answer."""
    yield from map(_tone, coupling.tones)
    yield from sweep_checks(coupling)


def sweep_checks(coupling: LinearCoupling) -> Iterable[str]:
    """Yield the results of the checks of all tones."""
    yield f"{coupling.route_why[0].upper()}{coupling.route_why[1:]}."
    drift = coupling.drift_per_cycle
    settled = f"NOT settled, drift {100 * drift:.2g} % per cycle" if drift != 0 else "settled"
    energy, beside = coupling.sideband_energy.value, "energy beside the tones unknown"
    if energy is not None:
        share = "less than 0.001 %" if energy < 1e-5 else f"{100 * energy:.2g} %"
        beside = f"energy beside the tones {share} of theirs"
    yield f"Checks: {settled}; {beside}. Valid {coupling.validity}."


def sweep_method(coupling: LinearCoupling) -> str:
    """Describe the method.

    Returns:
        A sentence in lower case, with its full stop.
    """
    return (
        f"{coupling.plan}, {coupling.runs} runs of {len(coupling.joints)} joints: H = Y C^-1 at "
        f"each tone, C as held by the servos ({1000 * coupling.hold_s:.3g} ms late); elements' "
        "intervals one by one at 95 % from the noise beside each tone (Student's t), those of "
        "indices at least 95 %; all matrices with --json."
    )


def _tone(tone: ToneCoupling) -> str:
    inverted = tone.inverted_condition if tone.route is Route.TORQUE else None
    numbers = {"C": tone.command_condition, "H": tone.condition_number, "Y": inverted}
    cond = [f"{of} {number:.3g}" for of, number in numbers.items() if number is not None]
    text = f"{tone.frequency_hz:.4g} Hz: condition numbers {', '.join(cond)}"
    if tone.asymmetry.value is not None:
        of = "X = H^-1" if tone.Z is None else "Z"
        asymmetry = formats.percent(tone.asymmetry)
        text += f"; {of}: asymmetry {asymmetry}, off-diagonal energy {_bands(tone)}"
    if tone.servo_difference is not None:
        off = formats.number(100 * tone.servo_difference, 1)
        text += f"; Z behind the described servos is {off} % off"
    if tone.distortion is not None:
        text += f"; distortion {100 * tone.distortion:.2g} %"
    return f"{text}."


def experiment_answer(
    reversal: Reversal | None,
    roles: Mapping[int, Role],
    pooled: PooledResponse | None = None,
    joints: Answer | None = None,
) -> str:
    """Answer from the reversal, or from the pooled runs of one direction.

    Args:
        reversal: Its result, or None.
        roles: Of the runs that have one. Of too few of a direction nothing is decided.
        pooled: The response over the runs of one direction, None where both were recorded.
        joints: Its answer on the joints.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not roles:
        return "no gait with a travelling wave in these sessions: nothing to compare"
    if len(set(roles.values())) == 1:
        return _one_direction(pooled, joints)
    if reversal is None:
        return "both directions, but not separable from these sessions"
    if reversal.p_floor >= SIGNIFICANT:
        return _too_few(reversal)
    return _different(reversal) if reversal.p < SIGNIFICANT else _bounded(reversal)


def broken_first(sessions: Sequence[Analysis], answer: str) -> str:
    """Put the joints that do not follow their command before what an experiment shows.

    Returns:
        The answer, with a clause for each of these joints and where it was so.
    """
    faults: dict[str, list[tuple[NotFollowing, str]]] = {}
    for session in sessions:
        for fault in session.answer.not_following:
            if fault.kinds != ("lost_samples",):
                faults.setdefault(fault.joint, []).append((fault, Path(session.session.path).name))
    clauses = [
        f"{fault_in_words(where[0][0])} ({_sessions([name for _, name in where], len(sessions))})"
        for where in list(faults.values())[:NAMED]
    ]
    if len(faults) > NAMED:
        clauses.append(f"{len(faults) - NAMED} more joints do not follow either")
    return "; ".join([*clauses, answer])


def _sessions(names: Sequence[str], count: int) -> str:
    if len(names) == count:
        return "all sessions"
    return f"in {names[0]}" if len(names) == 1 else f"in {len(names)} of {count} sessions"


def pair_order(pair: OrderedPair) -> str:
    """Describe which joint of a pair responds less.

    Returns:
        A clause; joints as they are named.
    """
    return f"{pair.name} answers less than its mirror {pair.mirror}"


def blind_spots(reversal: Reversal) -> str:
    """Describe the differences that a reversal of these joints can't detect."""
    middle = "" if reversal.middle is None else f" or of the middle joint, {reversal.middle}"
    return f"blind to what is alike at both joints of a pair{middle}"


def _one_direction(pooled: PooledResponse | None, joints: Answer | None) -> str:
    remains = "boundary or module is open: one direction only; record the reverse"
    if pooled is None or joints is None or not pooled.names:
        return remains
    runs = "1 run" if pooled.runs == 1 else f"{pooled.runs} runs pooled"
    return f"{runs}: {joints.sentence.rstrip('.')}; {remains}"


def _different(reversal: Reversal) -> str:
    reported = formats.p_value_text(reversal.p)
    if not reversal.pairs:
        cause = "check that ground and body are alike fore and aft"
        if not reversal.tilt.excluded:
            cause = "the floor may be tilted, or ground or body differ fore and aft"
        return (
            f"the two directions differ ({reported}), but not as a module would make them: {cause}"
        )
    first = reversal.pairs[0]
    either = f"{first.name} weaker or {first.mirror} stronger"
    either += "" if reversal.tilt.excluded else ", or the floor is tilted"
    others = len(reversal.pairs) - 1
    also = f"; {others} more pair{'s differ' if others > 1 else ' differs'}, by less"
    lead = "the modules differ: " if reversal.tilt.excluded else ""
    doubt = formats.p_value_text(first.p)
    return f"{lead}{pair_order(first)} ({doubt}): {either}{also if others else ''}"


def _too_few(reversal: Reversal) -> str:
    runs = f"{reversal.forward_runs} + {reversal.reverse_runs} runs"
    return (
        f"not decided: with {runs} no difference of a module can be shown, as p can't go below "
        f"{reversal.p_floor:.2g}; record at least 6 of each direction"
    )


def _bounded(reversal: Reversal) -> str:
    bound = (
        "no module differs from its mirror by more than "
        f"{_at_most(100 * reversal.gain_bound)} % in gain and "
        f"{_at_most(math.degrees(reversal.lag_bound_rad))}° in lag"
    )
    blind = blind_spots(reversal)
    share = reversal.boundary_share
    if share.value is None:
        return f"{bound}: the joints' spread is no more than noise; {blind}"
    stated = f"share {formats.percent(share)}"
    if share.ci95 is not None and share.ci95[0] > 0.5:
        return f"{bound}: the pattern is boundary ({stated}); {blind}"
    return (
        f"{bound}: boundary or module is still open (boundary {stated}); record more runs; {blind}"
    )


def _at_most(bound: float) -> str:
    """Format a bound with two digits, rounded up."""
    digits = formats.decimals_for_values([bound], 2)
    return formats.number(math.ceil(bound * 10**digits) / 10**digits, digits)
