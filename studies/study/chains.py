"""Part (d): chains of oscillators coupled by a path, by the body, or by both.

phi_i' = omega + sum_j K_ij sin(phi_j - phi_i - psi_ij), in units of eps. psi_ij are those of the
wanted pattern, so deviations theta from it follow theta_i' = sum_j K_ij sin(theta_j - theta_i).
K is that of a path (next neighbours, both ways, ``PATH`` each), of the body (K_ij = P_ij), or the
sum. The body is the identified one or its homogeneous comparator.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from undulog.analysis.oscillators.laplacian import smallest_singular, spectrum
from undulog.analysis.oscillators.predictions import homogeneous, path_laplacian
from undulog.capture.common.arrays import FloatArray
from undulog.sim.gait.oscillators import integrate

from .coupling import Kicked

PATH = 1.0
"""Coupling of next neighbours, both ways [eps]."""
DRAWN, START = 100, 1.0
"""Chains that start with phases drawn evenly up to +-START [rad]."""
SYNCHRONOUS = 0.9999
"""Order parameter from which on a chain counts as synchronous."""
RESAMPLES = 500
STEP, LONGEST = 0.1, 600.0
"""Between looks, and when a chain is given up [1/eps]."""
KINDS = ("path", "path + identified", "path + homogeneous", "identified", "homogeneous")


def coupling(kind: str, P: FloatArray) -> FloatArray:
    """Return the matrix whose rows sum to 1 and whose off-diagonal part is K."""
    body = np.eye(len(P))
    if "identified" in kind:
        body = P
    elif "homogeneous" in kind:
        body = homogeneous(P)
    return body - PATH * path_laplacian(len(P)) if "path" in kind else body


def order(theta: FloatArray) -> FloatArray:
    """Return the order parameter |mean exp(i theta)| of each chain, shape (chains,)."""
    return np.abs(np.exp(1j * theta).mean(axis=-1))


def times(
    M: FloatArray, draws: int = DRAWN, longest: float = LONGEST
) -> tuple[FloatArray, FloatArray]:
    """Return when each chain became synchronous for good, and the mean order at each look.

    Args:
        M: Of :func:`coupling`.

    Returns:
        Times [1/eps], infinite where it never did, shape (draws,); order, shape (looks,).
    """
    n = len(M)
    K = M - np.diag(np.diag(M))
    fastest = 2.0 * float(np.abs(K).sum(axis=1).max())

    def rate(_time: float, theta: FloatArray) -> FloatArray:
        s, c = np.sin(theta), np.cos(theta)
        return c * (s @ K.T) - s * (c @ K.T)

    theta = np.random.default_rng(n).uniform(-START, START, (draws, n))
    seen = [order(theta)]
    while len(seen) * STEP < longest and not (seen[-1] > 1.0 - 1e-5).all():
        theta = integrate(rate, theta, STEP, fastest)
        seen.append(order(theta))
    seen = np.array(seen)
    below = seen < SYNCHRONOUS
    last = len(seen) - np.argmax(below[::-1], axis=0)
    last = np.where(below.any(axis=0), last, 0)
    return np.where(below[-1], np.inf, last * STEP), seen.mean(axis=1)


def table(chains: list[Kicked], *, draws: int = DRAWN, longest: float = LONGEST) -> pd.DataFrame:
    """Return one row a chain and kind: gap, times, share of synchronous chains, order over time."""
    rows = []
    for chain in chains:
        for kind in KINDS:
            M = coupling(kind, chain.P)
            took, seen = times(M, draws, longest if "path" in kind else longest / 4)
            zero = np.zeros(1)
            rows.append(
                {
                    "n": chain.n,
                    "stall": chain.stall,
                    "kind": kind,
                    "gap": spectrum(M).gap,
                    "oracle": 4.0 * PATH * np.sin(np.pi / (2 * chain.n)) ** 2,
                    "times": took,
                    "median": float(np.median(took)),
                    "synchronous": float(np.isfinite(took).mean()),
                    "order": seen,
                    "detuned": 1.0 / float(smallest_singular(M, zero, zero)[0, 0]),
                }
            )
    return pd.DataFrame(rows)


def growth_with_n(frame: pd.DataFrame) -> pd.DataFrame:
    """Return exponents in n of time to synchrony, slowest rate and detuning, by stall and kind.

    The time is the median over the chains' starts, its interval by bootstrap over them; all kinds
    have the same starts, so ``against`` is the paired difference from the path alone. Kinds of
    which more than half of the chains never became synchronous have neither.
    """
    rows = []
    for (stall, kind), group in frame.groupby(["stall", "kind"], sort=False):
        logs = np.log(group["n"].to_numpy(dtype=float))
        if len(logs) < 2:
            continue
        drawn = _exponents(logs, group["times"].to_list())
        path = _exponents(logs, frame.loc[group.index - KINDS.index(kind), "times"].to_list())
        rows.append(
            {
                "stall": stall,
                "kind": kind,
                "lengths": len(logs),
                **_ends("", drawn),
                **_ends("against_", drawn - path),
                "settles": bool((group["gap"] > 0.0).all()),
                "detuned": np.polyfit(logs, np.log(group["detuned"].to_numpy()), 1)[0],
                "gap": np.polyfit(logs, np.log(np.abs(group["gap"].to_numpy())), 1)[0],
            }
        )
    return pd.DataFrame(rows)


def _exponents(logs: FloatArray, times_of: list[FloatArray]) -> FloatArray:
    """Return exponents of the median time: that of all starts first, then those of resamples."""
    random = np.random.default_rng(6)
    medians = [[np.median(durations) for durations in times_of]]
    for _ in range(RESAMPLES):
        picks = [
            durations[random.integers(0, len(durations), len(durations))] for durations in times_of
        ]
        medians.append([np.median(pick) for pick in picks])
    if not np.isfinite(medians).all():
        return np.full(1 + RESAMPLES, np.nan)
    return np.polyfit(logs, np.log(medians).T, 1)[0]


def _ends(name: str, drawn: FloatArray) -> dict[str, float]:
    low, high = np.quantile(drawn, (0.025, 0.975))
    return {f"{name}value": drawn[0], f"{name}low": low, f"{name}high": high}
