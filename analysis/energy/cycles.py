"""The energies of a session, cycle by cycle, with what they are made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from undulog.capture import Session
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import Warn

from ..results.energy import Closure, Each, EnergyResult, JointCycles, Transport
from ..signals.reading import Columns
from ..signals.windows import Span
from .joint import Energies, Energy

STEADY_SHARE = 0.2
"""A voltage that varies by less than this part of its mean is a supply's: a motor's follows the
duty, through zero and back in every cycle."""


def energy_result(
    session: Session,
    columns: Columns,
    energies: Mapping[str, Energies],
    span: Span,
    *,
    transport: Transport,
    closure: Closure | None,
    warn: Warn,
) -> EnergyResult:
    """Set the energies out in cycles.

    Args:
        session: An open session.
        columns: Its columns.
        energies: By joint name.
        span: The window.
        transport: Cost of transport.
        closure: Against the ledger, or None.
        warn: Told where E_el is made of the supply's voltage.

    Returns:
        The result.
    """
    shift_s = (span.origin_ns - session.start_ns) * 1e-9
    edges = np.linspace(span.start_s, span.stop_s, max(span.cycles, 1) + 1) + shift_s
    joints: list[JointCycles] = []
    for name, one in energies.items():
        mechanical, electrical = one.mechanical, one.electrical
        joints.append(
            JointCycles(
                name,
                net_j=_each(mechanical, "net_j"),
                plus_j=_each(mechanical, "plus_j"),
                abs_j=_each(mechanical, "abs_j"),
                el_j=_each(electrical, "net_j"),
                el_clipped_j=_each(electrical, "plus_j"),
                coverage=_each(mechanical, "covered"),
                el_coverage=_each(electrical, "covered"),
            )
        )
    source = electrical_source(session, columns)
    if source == "supply":
        topic = columns.topics["voltage"]
        warn(
            f"{topic} stays as it is while the joints work, so it is the supply's, not the "
            "motors': E_el is an upper bound"
        )
    return EnergyResult(
        tuple(edges[:-1].tolist()),
        tuple(edges[1:].tolist()),
        tuple(joints),
        source,
        transport,
        closure,
        _unknown(energies.values()),
    )


def electrical_source(session: Session, columns: Columns) -> str | None:
    """What electrical energy is made of.

    Args:
        session: An open session.
        columns: Its columns.

    Returns:
        ``simulated``, ``motor``, ``supply``, or None where current or voltage was not recorded.
    """
    both = [name for name in columns.voltage if name in columns.current]
    if not both:
        return None
    if "scenario" in session.metadata.get("undulog", {}):
        return "simulated"
    return "supply" if _all_steady(columns.voltage[name].values for name in both) else "motor"


def _unknown(energies: Iterable[Energies]) -> str | None:
    """What the log leaves open, in one sentence."""
    sampled = frozenset[str]().union(*(one.sampled for one in energies))
    factors = {"mechanical": "torque and velocity", "electrical": "voltage and current"}
    parts = [f"{kind} energies are products of sampled {factors[kind]}" for kind in sorted(sampled)]
    if not parts:
        return None
    return (
        f"{' and '.join(reversed(parts))}: what these do within a sampling interval is not in the "
        "log, so the error is unknown"
    )


def _all_steady(voltages: Iterable[FloatArray]) -> bool:
    for values in voltages:
        known = values[np.isfinite(values)]
        if known.size and np.ptp(known) > STEADY_SHARE * abs(float(known.mean())):
            return False
    return True


def _each(one: Energy | None, name: str) -> Each:
    return None if one is None else tuple(getattr(one, name).tolist())
