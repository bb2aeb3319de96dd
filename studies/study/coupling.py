"""Part (b): the phase-coupling matrix P of chains of several lengths, from rows of kicks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.linalg import expm

from undulog.analysis.oscillators.laplacian import (
    STRONG,
    growth,
    intervals_of,
    of_deviations,
    smallest_singular,
    spectrum,
)
from undulog.analysis.oscillators.predictions import explicit_coupling, homogeneous
from undulog.capture.common.arrays import FloatArray

from .design import HELD_OUT, KICK
from .rows import responses

ERRORS, EXPLICIT_DRAWS = 200, 40
"""Matrices drawn with the error that the rows' sums show."""
SPAN = np.linspace(0.0, 40.0, 81)
"""Times at which transient growth is looked for [1/eps]."""


@dataclass(frozen=True)
class Kicked:
    """P and R of one chain.

    Attributes:
        P: d psi / d psi_c, shape (n, n).
        R: d ln|a| / d psi_c, shape (n, n).
        error: Standard error of an entry of P, from the sums of its rows, which have to be 1.
        held_out: Error of P's prediction of the random patterns, over that of joints that keep
            their response; largest of the patterns.
        key: Of the base run's row.
    """

    n: int
    stall: float
    P: FloatArray
    R: FloatArray
    error: float
    held_out: float
    key: str

    def drawn(self) -> FloatArray:
        """Return matrices that P may be, their rows' sums 1, shape (draws, n, n)."""
        noise = np.random.default_rng(5).normal(0.0, self.error, (ERRORS, self.n, self.n))
        return self.P + noise - noise.mean(axis=2, keepdims=True)


def kicked(rows: pd.DataFrame) -> list[Kicked]:
    """Return the matrices of all chains whose kicks are complete."""
    chains = []
    for plan, group in rows[rows["plan"].str.startswith("kicks-")].groupby("plan"):
        _, n, stall = str(plan).split("-")
        done = group[(group["status"] == "done") & (group["n"] == int(n))]
        chain = _matrices(done, int(n), float(stall))
        chains += [] if chain is None else [chain]
    return sorted(chains, key=lambda kept: (kept.stall, kept.n))


def _matrices(rows: pd.DataFrame, n: int, stall: float) -> Kicked | None:
    turned = np.array(rows["start_phase"].tolist())
    if len(rows) < 2 * n + 3:
        return None
    y = dict(zip(map(tuple, turned.round(9).tolist()), responses(rows), strict=True))
    base = y[(0.0,) * n]
    up, down = (
        np.stack([y[tuple(phase)] for phase in (sign * KICK * np.eye(n) + 0.0).tolist()], axis=1)
        for sign in (1.0, -1.0)
    )
    slope = (up - down) / (2.0 * KICK)  # column j: the kicked command
    P, R = np.eye(n) + slope.imag, slope.real
    defect = P.sum(axis=1) - 1.0
    ratios = []
    for phase, response in y.items():
        if np.count_nonzero(phase) >= 2 and max(np.abs(phase)) <= HELD_OUT:
            moved = (response - base).imag + np.array(phase)
            kept, predicted = np.array(phase), P @ np.array(phase)
            ratios.append(np.linalg.norm(moved - predicted) / np.linalg.norm(moved - kept))
    base_key = rows["key"].iloc[int(np.flatnonzero(~turned.any(axis=1))[0])]
    error = float(np.sqrt(np.mean(defect**2) / n))
    return Kicked(n, stall, P, R, error, max(ratios), str(base_key))


def band_energy(P: FloatArray, reach: int) -> float:
    """Return the share of off-diagonal energy of P within |i - j| <= reach."""
    distance = np.abs(np.subtract.outer(np.arange(len(P)), np.arange(len(P))))
    off = np.where(distance > 0, P, 0.0) ** 2
    return float(off[distance <= reach].sum() / off.sum())


def reach_of(P: FloatArray, share: float = 0.9) -> int:
    """Return the smallest |i - j| within which so much of the off-diagonal energy lies."""
    return next(k for k in range(1, len(P)) if band_energy(P, k) >= share)


def henrici(P: FloatArray) -> float:
    """Return how far I - P is from normal, 0 for a normal matrix and always below 1.

    Args:
        P: d psi / d psi_c, shape (m, m).

    Returns:
        sqrt(||A||^2 - sum |lambda|^2) / ||A||, Frobenius, A = I - P on deviations that sum to 0
        (Henrici, Numerische Mathematik 4, 1962).
    """
    A = of_deviations(P)
    total = float(np.sum(A**2))
    inside = float(np.sum(np.abs(np.linalg.eigvals(A)) ** 2))
    return math.sqrt(max(0.0, total - inside) / total) if total > 0.0 else 0.0


def pattern_condition(P: FloatArray) -> float:
    """Return the condition number of the patterns: 1 where I - P is normal.

    A change of P by s moves no rate by more than this times s (Bauer & Fike, Numerische
    Mathematik 2, 1960).

    Args:
        P: d psi / d psi_c, shape (m, m).
    """
    return float(np.linalg.cond(np.linalg.eig(of_deviations(P)).eigenvectors))


def amplification(P: FloatArray) -> float:
    """Return how far deviations can grow beyond the slowest pattern's own course, at least 1.

    The largest norm of exp(-(A - gap) t), A = I - P on deviations; 1 for a normal matrix.
    """
    A = of_deviations(P)
    A = A - spectrum(P).gap * np.eye(len(A))
    return max(float(np.linalg.norm(expm(-A * t), ord=2)) for t in SPAN)


def measures(chains: list[Kicked]) -> pd.DataFrame:
    """Return one row a chain with what the page prints, NAME_low and NAME_high where drawn."""
    return pd.DataFrame([_measures(chain) for chain in chains])


def _explicit(chain: Kicked) -> dict[str, float]:
    """Return the path's coupling that lifts all rates to ``STRONG``, with this body and others."""
    drawn = [explicit_coupling(P) for P in chain.drawn()[:EXPLICIT_DRAWS]]
    low, high = np.quantile(drawn, (0.025, 0.975))
    value = explicit_coupling(chain.P)
    return {
        "explicit": value,
        "explicit_low": min(low, value),
        "explicit_high": max(high, value),
        "explicit_homogeneous": explicit_coupling(homogeneous(chain.P)),
        "explicit_alone": STRONG / (4.0 * np.sin(np.pi / (2 * chain.n)) ** 2),
    }


def _measures(chain: Kicked) -> dict[str, float | str]:
    modes, ends = spectrum(chain.P), intervals_of(chain.P, chain.drawn())
    other = spectrum(homogeneous(chain.P))
    zero = np.zeros(1)
    quantities = {
        "henrici": henrici,
        "condition": pattern_condition,
        "band1": lambda P: band_energy(P, 1),
        "band3": lambda P: band_energy(P, 3),
        "size": lambda P: float(np.linalg.norm(np.eye(len(P)) - P)),
    }
    row: dict[str, float | str] = {"n": chain.n, "stall": chain.stall, "key": chain.key}
    for name, of in quantities.items():
        drawn = [of(P) for P in chain.drawn()]
        low, high = np.quantile(drawn, (0.025, 0.975))
        value = of(chain.P)
        row |= {name: value, f"{name}_low": min(low, value), f"{name}_high": max(high, value)}
    return row | {
        "gap": modes.gap,
        "gap_low": ends.gap.ci95[0],
        "gap_high": ends.gap.ci95[1],
        "strong": modes.strong,
        "homogeneous_gap": other.gap,
        "homogeneous_strong": other.strong,
        **_explicit(chain),
        "growth": growth(chain.P),
        "amplification": amplification(chain.P),
        "reach90": reach_of(chain.P),
        "noise_level": float(smallest_singular(chain.P, zero, zero)[0, 0]),
        "diagonal_ends": float(np.diag(chain.P)[[0, -1]].mean()),
        "diagonal_inside": float(np.diag(chain.P)[1:-1].mean()),
        "row_defect": float(np.abs(chain.P.sum(axis=1) - 1.0).max()),
        "held_out": chain.held_out,
    }
