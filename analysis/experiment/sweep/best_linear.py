"""Best linear approximations, noise and distortion of the runs of a multisine experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.console import Warn

from ...frequency_response.estimate import Kind, joint_response, sound_lines
from ...frequency_response.periodic import (
    BestLinearApproximation,
    detection_lines,
    input_inverse,
    line_power,
    over_realisations,
    realisation_response,
)
from ...frequency_response.tones import LineResponse
from ...results import formats
from ...results.estimate import Estimate
from ...results.frequency_response import BestLinearJoint, BestLinearResponses, CrossResponse
from .multisine_runs import MultisineRun
from .runs import MOST_CONDITION

IMPURE = 0.01
"""Share of the commands at lines that the plan leaves out from which a warning is given."""


def best_linear_responses(runs: Sequence[MultisineRun], warn: Warn) -> BestLinearResponses | None:
    """Estimate the response of each joint.

    Args:
        runs: Of one experiment, at least one.

    Returns:
        None where no realisation can be used; warnings say why.
    """
    design, names = runs[0].design, runs[0].names
    periods = min(run.periods for run in runs)
    if periods < max(run.periods for run in runs):
        warn(f"some run has {periods} steady periods only: of all of them so many are used")
    orthogonal = design.inputs == "orthogonal" and len(names) > 1
    groups = _realisations(runs, warn, orthogonal=orthogonal)
    if not groups:
        return None
    joints = [name for name in names if all(name in run.response for run in runs)]
    if lost := [name for name in names if name not in joints]:
        warn(f"without a response in every run: {', '.join(lost)}")
    _warn_inputs(runs, (len(groups), periods), warn)
    lines: IntArray = np.array(design.lines)
    freedom = len(groups) - 1 or (periods - 1) * len(groups[0])
    whole = [_inverse(group, range(len(names))) for group in groups] if orthogonal else None
    found: list[BestLinearJoint] = []
    cross: list[CrossResponse] = []
    for joint in joints:
        place = names.index(joint)
        inverses = whole or [_inverse(group, [place]) for group in groups]
        spectra = [
            np.stack([run.response[joint][:periods] for run in group]) for group in groups
        ]  # (E, P, n) each
        each = [
            realisation_response(inverse, one[:, :, lines])
            for inverse, one in zip(inverses, spectra, strict=True)
        ]
        every = [
            over_realisations(
                np.stack([value[k] for value, _ in each]), np.stack([noise[k] for _, noise in each])
            )
            for k in range(len(each[0][0]))
        ]
        own = every[place if orthogonal else 0]
        sharing = () if orthogonal else tuple(name for name in names if name != joint)
        one = _joint(joint, sharing, own, freedom, lines / design.period_s)
        if one is None:
            warn(f"{joint}: no line has a response with an interval; it is left out")
            continue
        if periods > 1 and (lines % 2 == 1).all():
            beside = detection_lines([line_power(y).mean(axis=0) for y in spectra], lines)
            one = replace(one, odd=beside.odd, even=beside.even)
        found.append(one)
        if orthogonal:
            cross += [
                _cross(joint, name, other)
                for name, other in zip(names, every, strict=True)
                if name != joint
            ]
    if not found:
        return None
    return BestLinearResponses(
        inputs="orthogonal" if orthogonal else "same",
        realisations=len(groups),
        periods=periods,
        period_s=design.period_s,
        lines=design.lines,
        joints=tuple(found),
        cross=tuple(cross),
    )


def _realisations(
    runs: Sequence[MultisineRun], warn: Warn, *, orthogonal: bool
) -> list[list[MultisineRun]]:
    """Return the runs of each realisation that can be used."""
    by_number: dict[int, list[MultisineRun]] = {}
    for run in runs:
        by_number.setdefault(run.design.realisation, []).append(run)
    m = len(runs[0].names)
    found: list[list[MultisineRun]] = []
    for number, group in sorted(by_number.items()):
        if not orthogonal:
            if all(run.shared for run in group):
                found.append(group)
            else:
                warn(
                    f"realisation {number} is left out: its joints have different commands, though "
                    "one for all was expected"
                )
            continue
        regular = len(group) >= m
        if regular:
            matrices = np.moveaxis(np.stack([run.command for run in group], axis=1), 2, 0)
            regular = bool(np.linalg.cond(matrices).max() <= MOST_CONDITION)
        if regular:
            found.append(group)
        else:
            warn(
                f"realisation {number} is left out: its {len(group)} runs don't have the {m} "
                f"independent commands of {m} joints"
            )
    return found


def _inverse(group: Sequence[MultisineRun], inputs: Sequence[int]) -> ComplexArray:
    return input_inverse(np.stack([run.command[[*inputs]] for run in group], axis=1))


def _warn_inputs(runs: Sequence[MultisineRun], counts: tuple[int, int], warn: Warn) -> None:
    impurity = max(run.impurity for run in runs)
    if impurity > IMPURE:
        warn(
            f"the commands have {100 * impurity:.2g} % of their size at lines that they should "
            "leave out: distortion of odd and even order holds what the joints make of that"
        )
    if min(counts) < 2:
        one = "realisation" if counts[0] < 2 else "period"
        warn(f"one {one}: nonlinear distortion is not separable from noise")


def _joint(
    joint: str,
    sharing: tuple[str, ...],
    own: BestLinearApproximation,
    freedom: int,
    frequency_hz: FloatArray,
) -> BestLinearJoint | None:
    """Return the result of one joint; None where no line has an interval."""
    variance = own.total if own.realisations > 1 else own.noise
    every = np.full(frequency_hz.size, float(freedom))
    lines = sound_lines(LineResponse(frequency_hz, own.value, variance, every))
    if not lines.frequency_hz.size:
        return None
    kept = np.isin(frequency_hz, lines.frequency_hz)
    response = joint_response(joint, str(Kind.PERIODIC), sharing, lines)
    known = own.relative_distortion.value is not None
    return BestLinearJoint(
        response=replace(response, distortion=own.relative_distortion.value),
        noise_sd=_root(own.noise[kept]),
        distortion_sd=_root(own.distortion[kept]) if known else None,
        distortion=own.relative_distortion,
        odd=Estimate(),
        even=Estimate(),
    )


def _root(variance: FloatArray) -> tuple[float, ...] | None:
    if not np.isfinite(variance).all():
        return None
    return tuple(np.sqrt(np.maximum(variance, 0.0)).tolist())


def _cross(joint: str, command: str, one: BestLinearApproximation) -> CrossResponse:
    variance = one.total if one.realisations > 1 else one.noise
    return CrossResponse(
        joint,
        command,
        tuple(np.abs(one.value).tolist()),
        tuple((-np.angle(one.value)).tolist()),
        _root(variance) or (),
    )


def multisine_answer(found: BestLinearResponses | None) -> str:
    """Answer from the responses.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if found is None:
        return "no best linear approximation: the warnings say why"
    count = len(found.joints)
    low, high = (line / found.period_s for line in (found.lines[0], found.lines[-1]))
    lead = (
        f"best linear approximation of {count} joint{'s' if count > 1 else ''} at "
        f"{len(found.lines)} lines from {low:.3g} to {high:.3g} Hz, "
        f"{found.realisations} realisation{'s' if found.realisations > 1 else ''} of "
        f"{found.periods} period{'s' if found.periods > 1 else ''}"
    )
    worst = max(found.joints, key=lambda one: one.distortion.value or 0.0)
    if worst.distortion.value is None:
        return f"{lead}: nonlinear distortion is not separable from noise"
    return f"{lead}: {_distortion(worst, count)}"


def _distortion(worst: BestLinearJoint, count: int) -> str:
    where = f"at {worst.response.joint}" if count == 1 else f"largest at {worst.response.joint}"
    low = 0.0 if worst.distortion.ci95 is None else worst.distortion.ci95[0]
    if low <= 0:
        end = worst.distortion.value if worst.distortion.ci95 is None else worst.distortion.ci95[1]
        most = formats.number(100 * (end or 0.0), 2)
        return f"no nonlinear distortion is shown ({where} at most {most} %)"
    parts = [
        f"{name} order {formats.percent(level)}"
        for name, level in (("odd", worst.odd), ("even", worst.even))
        if level.value is not None
    ]
    orders = f" ({', '.join(parts)} of the response at the lines left out)" if parts else ""
    return f"nonlinear distortion {where}, {formats.percent(worst.distortion)} of the gain{orders}"


def multisine_method(found: BestLinearResponses) -> str:
    """Return the method as one sentence, beginning in lower case."""
    inputs = (
        "all commands the same"
        if found.inputs == "same"
        else "orthogonal commands of all joints, so that the response to each is known (--json)"
    )
    return (
        f"random-phase multisines, {inputs}: robust method (Pintelon & Schoukens 2012, 4.3); noise "
        "from the scatter of periods, noise and distortion together from that of realisations, "
        "odd and even order from the lines that the commands leave out; intervals at 95 % over "
        "the realisations (Student's t)."
    )
