"""A kick experiment in words: one sentence, and the lines below it."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ..results import formats
from ..results.coupling import Coupling, LocalCoupling, RowCheck, RunScatter
from ..results.estimate import Estimate, leaves_out_zero


def kick_answer(coupling: Coupling) -> str:
    """Answer from the coupling.

    Args:
        coupling: Of a kick experiment.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not isinstance(coupling, LocalCoupling):
        return f"coupling not identifiable from these kicks: {coupling.why}"
    told = "; ".join(part for part in (_largest(coupling), _linear(coupling)) if part)
    if not coupling.checks_pass:
        # The first thing said: nothing below holds as it would for a settled gait.
        told = f"doubtful, since {_rows_that_fail(coupling)} as shifting time demands; {told}"
    size = coupling.kick_size
    if size is not None and size.why is not None:
        told = f"{told}; {size.why}"
    return f"coupling around this gait: {told}"


def _largest(coupling: LocalCoupling) -> str:
    """The largest element of P off the diagonal that is shown to be one.

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
    most = formats.number(
        100 * index.ci95[1], formats.decimals_for_values([100 * index.ci95[1]], 2)
    )
    return f"no nonlinearity is shown (at most {most} %)"


def _rows_that_fail(coupling: LocalCoupling) -> str:
    parts = (("P", 1, coupling.phase_rows), ("R", 0, coupling.gain_rows))
    off = {
        f"rows of {symbol} don't sum to {total}": max(
            abs((row.total.value or 0.0) - row.expected) / max(row.standard_error, 1e-12)
            for row in rows
        )
        for symbol, total, rows in parts
    }
    return max(off, key=lambda text: off[text])


def kick_detail(coupling: LocalCoupling) -> Iterable[str]:
    """What stands below the answer.

    Args:
        coupling: Of a kick experiment.

    Yields:
        Sentences.
    """
    yield from kick_checks(coupling)
    yield from held_out_detail(coupling)
    size = coupling.kick_size
    if size is not None:
        yield (
            f"Kicks of {size.phase_rad:.2g} rad show couplings of {size.resolved:.2g} and more; "
            f"what they do is {100 * size.curvature:.2g} % of second order: {size.verdict}."
        )


def kick_checks(coupling: LocalCoupling) -> Iterable[str]:
    """What was checked, and what the kicks say of a linear chain.

    Args:
        coupling: Of a kick experiment.

    Yields:
        Sentences.
    """
    said = "pass" if coupling.checks_pass else "FAIL"
    yield (
        f"Time shift: rows of P sum to 1 within {_worst(coupling.phase_rows)}, rows of R to 0 "
        f"within {_worst(coupling.gain_rows)}: {said}."
    )
    if coupling.scatter is not None:
        yield _scatter(coupling.scatter)
    lti = coupling.lti
    if lti.asymmetry.value is not None:
        bands = ", ".join(
            f"{formats.percent(share)} within {k} joint{'s' if k > 1 else ''}"
            for k, share in enumerate((lti.within_1, lti.within_2, lti.within_3), start=1)
        )
        yield (
            "Read as a linear time-invariant chain, which it is not unless the nonlinearity is "
            f"small: X = H^-1 (condition number {coupling.condition_number:.3g}) has asymmetry "
            f"{formats.percent(lti.asymmetry)}; off-diagonal energy {bands}."
        )


def held_out_detail(coupling: LocalCoupling) -> Iterable[str]:
    """How well runs that were not used are predicted.

    Args:
        coupling: Of a kick experiment.

    Yields:
        Sentences.
    """
    for one in coupling.held_out:
        yield (
            f"Held out, {one.session}: deviations up to {one.size:.3f}, error "
            f"{100 * one.error:.2f} % (noise {100 * one.noise:.2f} %), 'each joint keeps its "
            f"response' {100 * one.error_kept:.2f} %."
        )
    if coupling.valid_to is not None:
        yield f"Valid for deviations up to {coupling.valid_to:.3f} rad, as far as was tried."


def _scatter(scatter: RunScatter) -> str:
    """How much runs differ, in degrees and percent."""
    phase, gain = (np.array(one) for one in (scatter.phase_rad, scatter.log_gain))
    noise = np.degrees(np.median(scatter.phase_noise_rad))
    widened = "" if scatter.widened <= 1 else f"; errors widened by up to {scatter.widened:.2g}"
    return (
        f"Runs differ by {np.degrees(np.median(phase)):.2g}° (median of the joints, at most "
        f"{np.degrees(phase.max()):.2g}°) and {100 * np.median(gain):.2g} % beyond the noise "
        f"within them ({noise:.2g}°), with {scatter.dof} degrees of freedom; all intervals have "
        f"it{widened}."
    )


def _worst(rows: tuple[RowCheck, ...]) -> str:
    """The largest deviation of a row's sum, with its standard error."""
    worst = max(rows, key=lambda row: abs((row.total.value or 0.0) - row.expected))
    off = abs((worst.total.value or 0.0) - worst.expected)
    digits = 1 - math.floor(math.log10(max(off, worst.standard_error, 1e-6)))
    return f"{off:.{digits}f} ({worst.name}, standard error {worst.standard_error:.{digits}f})"
