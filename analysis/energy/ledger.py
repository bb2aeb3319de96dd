"""Energies against the twin's own ledger, where a session has one.

The twin books energy at its physics rate. An analysis that has to multiply samples misses what
happens between them; where the two differ by much, there is a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError

from ..estimators.series import clean
from ..results.energy import Closure
from ..signals.windows import Span
from .joint import Energies

LEDGER_TOPIC = "/energy_ledger"
TERMS = {
    "net": ("mechanical", "mechanical_net"),
    "plus": ("mechanical", "mechanical_plus"),
    "abs": ("mechanical", "mechanical_abs"),
    "el": ("electrical", "electrical_net"),
    "el_clipped": ("electrical", "electrical_plus"),
}
"""Energy to what it is of, and to its term in the ledger."""

TOLERANCE = 0.05
"""Difference, as a share of the absolute energy, that is worth a warning."""


def check_ledger(
    session: SessionView, energies: Iterable[Energies], span: Span, warn: Warn
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
    try:
        booked = booked_energies(session, span)
    except (DataError, LogError) as error:
        warn(f"{LEDGER_TOPIC} can't be read: {error}")
        return None
    if booked is None:
        return None
    found = whole_robot(energies)
    off: dict[str, float] = {}
    for name, (kind, term) in TERMS.items():
        if name in found and term in booked:
            off[name] = found[name] - booked[term]
            scale = max(found["abs" if kind == "mechanical" else "el_abs"], abs(booked[term]))
            if name in ("net", "el") and abs(off[name]) > TOLERANCE * scale:
                warn(
                    f"{kind} energy is {found[name]:.4g} J from the samples but {booked[term]:.4g} "
                    f"J in the twin's ledger ({LEDGER_TOPIC}): samples once a control cycle miss "
                    "what happens within it"
                )
    whole = booked.get("mechanical_abs", 0.0)

    def share(energy_j: float | None) -> float | None:
        return None if energy_j is None or whole <= 0 else energy_j / whole

    return Closure(
        mechanical_balance=share(booked.get("mechanical_residual")),
        electrical_balance=share(booked.get("electrical_residual")),
        **{name: share(off.get(name)) for name in TERMS},
    )


def booked_energies(session: SessionView, span: Span) -> dict[str, float] | None:
    """What the twin's ledger books over a window.

    Args:
        session: An open session.
        span: The window.

    Returns:
        Energies of the whole robot [J], by the ledger's terms; None where there is no ledger.

    Raises:
        DataError: If the ledger's topic can't be read.
        LogError: If the file can't.
    """
    if LEDGER_TOPIC not in session.channels:
        return None
    ledger = session.joints(LEDGER_TOPIC)
    booked: dict[str, float] = {}
    for name, t_ns, values in zip(ledger.names, ledger.t_ns, ledger.values, strict=True):
        term = clean(name, t_ns, values, span.origin_ns)
        if term.count > 1 and term.t_s[0] <= span.stop_s:
            # Cumulative, so that a difference is the energy of the window.
            late, early = (
                float(np.interp(t, term.t_s, term.values)) for t in (span.stop_s, span.start_s)
            )
            booked[name] = late - early
    return booked


def whole_robot(energies: Iterable[Energies]) -> Mapping[str, float]:
    """Energies of all joints together.

    Args:
        energies: Of the joints.

    Returns:
        Sums [J], by the names in :data:`TERMS`, with ``el_abs`` besides; those that no joint has
        are absent.
    """
    joints = list(energies)
    sums: dict[str, float] = {}
    for kind, names in (
        ("mechanical", ("net", "plus", "abs")),
        ("electrical", ("el", "el_clipped", "el_abs")),
    ):
        known = [one for one in (getattr(joint, kind) for joint in joints) if one is not None]
        for name, part in zip(names, ("net_j", "plus_j", "abs_j"), strict=True):
            if known:
                sums[name] = sum(float(getattr(one, part).sum()) for one in known)
    return sums
