"""A kick experiment in words: one sentence, and the lines below it."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ..results.analysis import Coupling, Estimate
from ..results.coupling import LocalCoupling, RowCheck
from ..text import formats


def kick_answer(coupling: Coupling) -> str:
    """Answer from the coupling.

    Args:
        coupling: Of a kick experiment.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not isinstance(coupling, LocalCoupling):
        return f"coupling not identifiable from these kicks: {coupling.why}"
    P = np.array(coupling.P.value)
    off = ~np.eye(len(P), dtype=bool)
    i, j = (int(k) for k in np.unravel_index(np.argmax(np.abs(P) * off), P.shape))
    half = coupling.P.ci95_half[i][j]
    largest = Estimate(float(P[i, j]), (float(P[i, j]) - half, float(P[i, j]) + half))
    told = (
        f"coupling around this gait: {coupling.joints[i]} follows the phase of "
        f"{coupling.joints[j]} most, by {formats.estimate(largest)}"
    )
    if coupling.nonlinearity.value is None:
        return told
    return f"{told}; nonlinearity {formats.percent(coupling.nonlinearity)}"


def kick_detail(coupling: LocalCoupling) -> Iterable[str]:
    """What stands below the answer.

    Args:
        coupling: Of a kick experiment.

    Yields:
        Sentences.
    """
    yield from kick_checks(coupling)
    yield from held_out_detail(coupling)


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


def _worst(rows: tuple[RowCheck, ...]) -> str:
    """The largest deviation of a row's sum, with its standard error."""
    worst = max(rows, key=lambda row: abs((row.total.value or 0.0) - row.expected))
    off = abs((worst.total.value or 0.0) - worst.expected)
    digits = 1 - math.floor(math.log10(max(off, worst.standard_error, 1e-6)))
    return f"{off:.{digits}f} ({worst.name}, standard error {worst.standard_error:.{digits}f})"
