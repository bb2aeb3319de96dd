"""A calibration in words, and as one JSON object."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .determined import Ridge
from .fit import Calibration, Fitted
from .misfit import Misfit
from .parameters import DELAY

NOT_NOISE = 3.0
"""An autocorrelation time of the residual from which it is called out [samples]."""


def told(calibration: Calibration) -> Iterator[str]:
    """Lines for a terminal.

    Args:
        calibration: The fit.

    Yields:
        The answer first, joints last.
    """
    before, after = (_rms(one) for one in (calibration.before, calibration.after))
    yield (
        f"{calibration.session} in {calibration.world}: twin and robot are {before:.3g} rad apart "
        f"(RMS) before, {after:.3g} rad after; {calibration.iterations} iterations, "
        f"{calibration.runs} runs at {calibration.speed:.1f} x real time"
    )
    if not calibration.converged:
        yield "The fit did not come to an end: take its numbers as a step on the way."
    yield "Parameters (95 % interval; before):"
    width = max(len(one.label) for one in calibration.parameters)
    for one in calibration.parameters:
        yield f"  {_parameter(one, width)}"
    yield from _undetermined(calibration)
    yield from _search(calibration)
    if calibration.memory > NOT_NOISE:
        yield (
            f"What is left has a memory of {calibration.memory:.0f} samples: it isn't the noise of "
            "encoders alone. The twin lacks something that the robot has; no interval covers that."
        )
    yield "Joints (before -> after):"
    for joint, first in calibration.before.items():
        yield f"  {joint}  {_misfit(first, calibration.after[joint])}"


def reported(calibration: Calibration) -> dict[str, Any]:
    """The calibration as plain JSON values.

    Args:
        calibration: The fit.

    Returns:
        SI units; ``within`` of intervals as pairs.
    """
    search = calibration.search
    return {
        "session": calibration.session,
        "world": calibration.world,
        "parameters": [
            {
                "name": one.name,
                "module": one.module,
                "unit": one.unit,
                "start": one.start,
                "value": one.value,
                "ci95": list(one.ci95),
                "determined": one.determined,
            }
            for one in calibration.parameters
        ],
        "undetermined": [one.label for one in calibration.parameters if not one.determined],
        "ridges": [{"left": one.left, "factors": one.factors} for one in calibration.ridges],
        "would_tell": list(calibration.would_tell),
        "search": None
        if search is None
        else {
            "module": search.module,
            "p": search.p,
            "tried": search.tried,
            "named": search.named,
        },
        "misfit": {
            joint: {"before": vars(first), "after": vars(calibration.after[joint])}
            for joint, first in calibration.before.items()
        },
        "rms_rad": {"before": _rms(calibration.before), "after": _rms(calibration.after)},
        "residual_memory_samples": calibration.memory,
        "iterations": calibration.iterations,
        "converged": calibration.converged,
        "runs": calibration.runs,
        "real_time_factor": calibration.speed,
    }


def _rms(misfits: dict[str, Misfit]) -> float:
    return float(np.sqrt(np.mean([one.rms**2 for one in misfits.values()])))


def _parameter(one: Fitted, width: int) -> str:
    low, high = one.ci95
    scale, unit = (1e3, "ms") if one.name == DELAY else (1.0, "" if one.unit == "1" else one.unit)
    numbers = f"{scale * one.value:.4g} [{scale * low:.4g}, {scale * high:.4g}]"
    before = "" if one.name == DELAY else f"; {scale * one.start:.4g}"
    open_ = "" if one.determined else ", undetermined"
    return f"{one.label:{width}}  {numbers} {unit}".rstrip() + before + open_


def _undetermined(calibration: Calibration) -> Iterator[str]:
    open_ones = [one.label for one in calibration.parameters if not one.determined]
    if not open_ones:
        return
    yield f"Undetermined by this session: {', '.join(open_ones)}."
    for ridge in calibration.ridges:
        yield f"  answers alike: {_ridge(ridge)}"
    for line in calibration.would_tell:
        yield f"  what would tell {line}"


def _ridge(ridge: Ridge) -> str:
    return ", ".join(
        f"{label} + {1e3 * factor:.2g} ms" if label == DELAY else f"{label} x {factor:.2f}"
        for label, factor in ridge.factors.items()
    )


def _search(calibration: Calibration) -> Iterator[str]:
    search = calibration.search
    if search is None:
        return
    p = "p < 0.001" if search.p < 0.001 else f"p = {search.p:.3f}"
    if search.named:
        yield f"Of {search.tried} modules {search.module} differs ({p}, family-wise)."
    else:
        yield (
            f"Of {search.tried} modules none is shown to differ; {search.module} would be the "
            f"first ({p}, family-wise)."
        )


def _misfit(first: Misfit, last: Misfit) -> str:
    text = f"{first.rms:.4f} -> {last.rms:.4f} rad"
    if first.gain is None or last.gain is None or first.late_s is None or last.late_s is None:
        return text
    return (
        f"{text}; gain {100 * first.gain:+.1f} -> {100 * last.gain:+.1f} %; late "
        f"{1e3 * first.late_s:+.1f} -> {1e3 * last.late_s:+.1f} ms"
    )
