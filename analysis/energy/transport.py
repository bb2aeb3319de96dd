"""Cost of transport: energy over weight times the way of the centre of mass, in whole cycles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.robot.model import Robot

from ..body.steps import GRAVITY, body_steps
from ..estimators.intervals import around, t_factor
from ..estimators.series import Series
from ..results.energy import Transport
from ..results.estimate import Estimate
from ..results.remarks import Note
from ..signals.windows import Span
from .joint import Energies, Energy

LEAST_WAY = 0.01
"""Displacement in a cycle, over the body's length, below which a robot goes nowhere."""


def transport(
    session: SessionView,
    responses: Mapping[str, Series],
    energies: Mapping[str, Energies],
    span: Span,
    warn: Warn,
) -> Transport:
    """Cost of transport of a session.

    Args:
        session: An open session.
        responses: Measured joint angles that can be trusted, by name.
        energies: By joint name, in cycles.
        span: Whole cycles.
        warn: Told why there is no value.

    Returns:
        The cost, or the reason why it is not applicable.
    """
    mass = None if session.robot is None else session.robot.total_mass
    nothing = Estimate()
    distance = nothing
    reasons: list[str] = []

    def refuse(sentence: str) -> None:
        reasons.append(sentence.rpartition("no cost of transport: ")[2])

    steps = body_steps(session, responses, span, refuse)
    if steps is not None and session.robot is not None:
        distance = _distance(steps.forward_m)
        reasons += _goes_nowhere(steps.forward_m, distance, session.robot)
    if steps is None or reasons:
        why = "; ".join(reasons)
        warn(Note(f"cost of transport is not applicable: {why}"))
        return Transport(distance, mass, *[nothing] * 5, why=why)
    weighed = steps.mass_kg * GRAVITY * steps.forward_m
    kinds = {
        "mechanical": [one.mechanical for one in energies.values()],
        "electrical": [one.electrical for one in energies.values()],
    }
    cost: dict[str, Estimate] = {}
    lacking: list[str] = []
    for kind, found in kinds.items():
        sums = _sums(found)
        if sums is None:
            lacking.append(f"no {kind} energy of some joints")
            sums = {}
        for name in ("net", "plus", "abs"):
            value = _ratio(sums[name], weighed) if name in sums else nothing
            cost[f"{kind} {name}"] = value
    if lacking:
        warn(Note(f"cost of transport is partly null: {' and '.join(lacking)}"))
    return Transport(
        distance,
        mass,
        cost["mechanical net"],
        cost["mechanical plus"],
        cost["mechanical abs"],
        cost["electrical net"],
        cost["electrical plus"],
        "; ".join(lacking),
    )


def _distance(way: FloatArray) -> Estimate:
    """Net displacement, with the interval that its scatter over cycles gives."""
    half = t_factor(way.size - 1) * float(way.std(ddof=1)) * way.size**0.5
    total = float(way.sum())
    return Estimate(total, around(total, half))


def _goes_nowhere(way: FloatArray, distance: Estimate, robot: Robot) -> list[str]:
    """Why a displacement can't be divided by; empty where it can."""
    total = float(way.sum())
    least = LEAST_WAY * sum(link.length for link in robot.links) * way.size
    if total >= least and distance.ci95 is not None and distance.ci95[0] > 0:
        return []
    moved = f"the centre of mass moves by {1000 * total:.3g} mm in {way.size} cycles"
    return [f"{moved}, which can't be told from 0"]


def _sums(found: Sequence[Energy | None]) -> dict[str, FloatArray] | None:
    """Energies of all joints together in each cycle; None if one is unknown."""
    known = [one for one in found if one is not None]
    if not known or len(known) < len(found):
        return None
    return {
        "net": np.sum([one.net_j for one in known], axis=0),
        "plus": np.sum([one.plus_j for one in known], axis=0),
        "abs": np.sum([one.abs_j for one in known], axis=0),
    }


def _ratio(above: FloatArray, below: FloatArray) -> Estimate:
    """Ratio of two sums over cycles, with the interval of a ratio estimator.

    With r the ratio, var r = n / (n - 1) sum (a - r b)^2 / (sum b)^2 (Cochran, Sampling Techniques,
    1977, section 6.3).
    """
    n, total = above.size, float(below.sum())
    value = float(above.sum()) / total
    scatter = float(np.sum((above - value * below) ** 2))
    half = t_factor(n - 1) * (n / (n - 1) * scatter) ** 0.5 / abs(total)
    return Estimate(value, around(value, half))
