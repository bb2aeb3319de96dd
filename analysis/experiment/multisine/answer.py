"""The answer of a multisine experiment in sentences."""

from __future__ import annotations

from ...results import formats
from ...results.frequency_response import BestLinearJoint, BestLinearResponses


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
