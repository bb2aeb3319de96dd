"""Energies against the twin's own ledger, where a session has one.

The twin books energy at its physics rate; an analysis integrates samples that are ten times
rarer and always fall at the same instant of the control cycle. Where the two differ, that is the
sampling, and it is said.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from capture import Session
from capture.errors import DataError, LogError

from ..estimators.series import clean
from ..joints import Energies, Span
from ..reading import Warn
from ..results.energy import Closure

LEDGER_TOPIC = "/energy_ledger"
TOLERANCE = 0.05
"""Difference, as a share of the absolute energy, that is worth a warning."""


def check_ledger(
    session: Session, energies: Iterable[Energies], span: Span, warn: Warn
) -> Closure | None:
    """Compare the joints' energies with the ledger's over the same window, and close its balance.

    Args:
        session: An open session.
        energies: Of all joints.
        span: The window.
        warn: Told where they differ by more than ``TOLERANCE``.

    Returns:
        The closure, or None where the session has no ledger.
    """
    if LEDGER_TOPIC not in session.channels:
        return None
    try:
        ledger = session.joints(LEDGER_TOPIC)
    except (DataError, LogError) as error:
        warn(f"{LEDGER_TOPIC} can't be read: {error}")
        return None
    booked: dict[str, float] = {}
    for name, t_ns, values in zip(ledger.names, ledger.t_ns, ledger.values, strict=True):
        term = clean(name, t_ns, values, span.origin_ns)
        if term.count > 1 and term.t_s[0] <= span.stop_s:
            # Cumulative, so that a difference is the energy of the window.
            late, early = (
                float(np.interp(t, term.t_s, term.values)) for t in (span.stop_s, span.start_s)
            )
            booked[name] = late - early
    joints = list(energies)
    mechanical = [one.mechanical for one in joints if one.mechanical is not None]
    electrical = [one.electrical for one in joints if one.electrical is not None]
    off: dict[str, float] = {}
    for name, found in (("mechanical", mechanical), ("electrical", electrical)):
        if not found or f"{name}_net" not in booked:
            continue
        ours = sum(float(one.net_j.sum()) for one in found)
        scale = sum(float(one.abs_j.sum()) for one in found)
        theirs = booked[f"{name}_net"]
        off[name] = ours - theirs
        if abs(ours - theirs) > TOLERANCE * max(scale, abs(theirs)):
            warn(
                f"{name} energy is {ours:.4g} J from the samples but {theirs:.4g} J in the twin's "
                f"ledger ({LEDGER_TOPIC}): samples once a control cycle miss what happens within it"
            )
    whole = booked.get("mechanical_abs", 0.0)

    def share(energy_j: float | None) -> float | None:
        return None if energy_j is None or whole <= 0 else energy_j / whole

    absolute = sum(float(one.abs_j.sum()) for one in mechanical) if mechanical else None
    return Closure(
        mechanical_balance=share(booked.get("mechanical_residual")),
        electrical_balance=share(booked.get("electrical_residual")),
        net=share(off.get("mechanical")),
        abs=share(None if absolute is None else absolute - whole),
        el=share(off.get("electrical")),
    )
