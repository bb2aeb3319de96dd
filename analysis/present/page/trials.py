"""Present the tests of a result as questions with answers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from undulog.capture.common.console import plain

from ...experiment.reversal import SIGNIFICANT
from ...results import formats
from ...results.analysis import Index
from ...results.coupling import LocalCoupling, RowCheck
from ...results.estimate import Estimate
from ...results.experiment import Experiment, Reversal
from ...segments.answer import find

LEVEL_NOTE = (
    f"Each test stands by itself at a level of {100 * SIGNIFICANT:g} %; those that look at several "
    "joints at once are family-wise over them. A question that could not be answered is open, not "
    "answered with no."
)


_MARGINS = {"gain": "2 %", "lag": "1°"}


@dataclass(frozen=True)
class Trial:
    """A test as a question.

    Attributes:
        statistic: With unit and interval.
        p: Of the null hypothesis; None if the answer rests on an interval or a bound.
    """

    question: str
    statistic: str
    p: float | None
    verdict: str


def session_trials(indices: Mapping[str, Index]) -> list[Trial]:
    """Return the tests of one session, plane by plane."""
    found = [
        _common(index, _of(plane)) for plane, index in find(indices, "common_response").items()
    ]
    for quantity in ("gain", "lag"):
        for plane, index in find(indices, f"boundary_contrast_{quantity}").items():
            found.append(_contrast(index, quantity, _of(plane)))
    for quantity in ("gain", "lag"):
        for plane, index in find(indices, f"equivalence_{quantity}").items():
            question = f"within {_MARGINS[quantity]} of the mean of {_of(plane)}?"
            found.append(_equivalence(index, quantity, f"Is every {quantity} {question}"))
    return found


def experiment_trials(experiment: Experiment) -> list[Trial]:
    """Return the tests of several sessions together."""
    found: list[Trial] = []
    indices = experiment.heterogeneity
    common = indices.get("common_response")
    if common is not None and common.value is not None:
        found.append(_common(common, "the driven joints"))
    if experiment.reversal is not None:
        found += _reversal(experiment.reversal, indices)
    if isinstance(experiment.coupling, LocalCoupling):
        found += _kicks(experiment.coupling)
    return found


def _kicks(coupling: LocalCoupling) -> Iterable[Trial]:
    sums = "as any settled gait's do" if coupling.checks_pass else "not in all rows: settle longer"
    for symbol, rows in (("P", coupling.phase_rows), ("R", coupling.gain_rows)):
        question = f"Do rows of {symbol} sum to {rows[0].expected:g}, as shifting time demands?"
        yield Trial(question, f"largest deviation {_worst(rows)}", None, sums)
    index = coupling.nonlinearity
    if index.value is not None and index.ci95 is not None:
        linear = index.ci95[0] <= 0.0
        yield Trial(
            "Is the chain linear and time-invariant around this gait?",
            f"nonlinearity {formats.percent(index)}",
            None,
            "a deviation could not be shown" if linear else "no: H is descriptive only",
        )
    if coupling.held_out:
        good = sum(2 * one.error <= one.error_kept for one in coupling.held_out)
        reach = coupling.valid_to
        yield Trial(
            "Do the matrices predict gaits that were not used?",
            f"{good} of {len(coupling.held_out)} at least twice as well as 'each joint keeps "
            "its response'",
            None,
            "not even the smallest" if reach is None else f"yes, up to {reach:.3f} rad",
        )


def _of(end: str) -> str:
    plane, _, group = end.partition("group")
    words = {"horizontal": "the yaw joints", "vertical": "the pitch joints"}
    word = words.get(plane.rstrip("_"), "the driven joints")
    return f"{word} of group {group}" if group else word


def _common(index: Index, whose: str) -> Trial:
    different = index.p is not None and index.p < SIGNIFICANT
    return Trial(
        f"Do {whose} all have the same gain and lag? (H0)",
        f"F = {formats.number(index.value, 1)}",
        index.p,
        "no, they differ" if different else "open: no difference could be shown",
    )


def _contrast(index: Index, quantity: str, whose: str) -> Trial:
    value = Estimate(index.value, index.ci95)
    if quantity == "lag":
        size = formats.estimate(formats.degrees(value), "°")
    else:
        size = formats.estimate(value, most=5)
    low, high = index.ci95 or (-math.inf, math.inf)
    verdict = "open: no difference could be shown"
    if low > 0 or high < 0:
        verdict = f"yes, {quantity} is larger {'at the ends' if low > 0 else 'in the middle'}"
    question = f"Does {quantity} differ between ends and middle of {whose}?"
    return Trial(question, f"ends minus middle {size}", index.p, verdict)


def _equivalence(index: Index, quantity: str, question: str) -> Trial:
    alike = index.p is not None and index.p < SIGNIFICANT
    scale, unit = (100.0, " %") if quantity == "gain" else (180.0 / math.pi, "°")
    return Trial(
        question,
        f"largest deviation {formats.number(scale * (index.value or 0.0), 2)}{unit}",
        index.p,
        "yes, shown to be alike" if alike else "not shown",
    )


def _reversal(reversal: Reversal, indices: Mapping[str, Index]) -> Iterable[Trial]:
    different = reversal.p < SIGNIFICANT
    no = "no, but not as a module would make it"
    if reversal.pairs:
        no = f"no, modules differ{'' if reversal.tilt.excluded else ' or the floor is tilted'}"
    yield Trial(
        "Do the modules mirror, as identical ones do? (H1, reversal)",
        f"T = {formats.number(reversal.statistic, 2)}",
        reversal.p,
        no if different else "open: no difference could be shown",
    )
    for quantity in ("gain", "lag"):
        index = indices.get(f"equivalence_mirror_{quantity}")
        if index is not None and index.value is not None:
            question = f"Is every joint's {quantity} within {_MARGINS[quantity]} of its mirror's?"
            yield _equivalence(index, quantity, question)


def _worst(rows: tuple[RowCheck, ...]) -> str:
    worst = max(rows, key=lambda row: abs((row.total.value or 0.0) - row.expected))
    off = abs((worst.total.value or 0.0) - worst.expected)
    digits = formats.decimals_for_values([off], 2)
    return f"{formats.number(off, digits)} ({plain(worst.name)})"
