"""Energies in words."""

from __future__ import annotations

from collections.abc import Iterator

from ...common import formats
from .result import EnergyResult


def energy_lines(energy: EnergyResult) -> Iterator[str]:
    """Yield the cost of transport, what is unknown of it, and the closure against the ledger."""
    cost = energy.transport
    named = (("E_net", cost.net), ("E_abs", cost.abs), ("E_el", cost.el))
    if costs := [
        f"{name} {formats.estimate(estimate, most=4)}" for name, estimate in named if estimate.value
    ]:
        way = formats.estimate(cost.distance_m, " m", most=3)
        yield f"Cost of transport E/(m g d): {', '.join(costs)}, over {way}"
    if energy.unknown is not None:
        yield formats.sentence(energy.unknown)
    closure = energy.closure
    if closure is not None and closure.mechanical_balance is not None:
        parts = [f"balance {100 * closure.mechanical_balance:.3f} %"]
        parts += [] if closure.net is None else [f"E_net {100 * closure.net:.2f} %"]
        parts += [] if closure.el is None else [f"E_el {100 * closure.el:.2f} %"]
        yield f"Against the twin's ledger, in % of E_abs: {', '.join(parts)}"
