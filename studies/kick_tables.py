"""The tables of docs/explanation/method.md on kicks, whose runs differ beyond their own noise.

``nice .venv/bin/python studies/kick_tables.py`` prints them as Markdown; it takes about a minute
and a half. ``studies/kick_tables.py 2000`` makes so many experiments a row.

Each experiment is the one that ``undulog plan phase-kicks`` writes, on a linear chain whose P, R, G
and S are known in closed form. Each run's phases and log amplitudes scatter; the fit within a run
knows its noise, 0.01 degrees, and nothing of the scatter.
"""

from __future__ import annotations

import sys

import numpy as np

from undulog.analysis.experiment.kick_runs import Kick, KickKind
from undulog.analysis.experiment.local_coupling import (
    ResponseMatrices,
    local_matrices,
    nonlinearity,
)

NOISE = np.radians(0.01)
"""Of one run's phase as its fit knows it [rad], and of its log amplitude."""

FIT_DOF = 20.0
KICK = 0.05


def chain(m, *, coupled=True):
    """Return a response matrix and the commands of a wave.

    Args:
        m: Joints.
        coupled: Whether joints answer each other's commands.

    Returns:
        H, shape (m, m), and c, shape (m,).
    """
    place = np.arange(m)
    H = np.diag(np.full(m, 0.9 * np.exp(-0.3j)))
    if coupled:
        H = H + 0.12 * np.exp(-np.abs(place[:, None] - place[None, :]) + 0.5j * place[None, :])
    return H, 0.4 * np.exp(-1j * np.pi / 3 * place)


def plan(m, base_runs=6):
    """Return the kicks of an experiment, None for a run of the gait as it is."""
    kinds = (KickKind.PHASE, KickKind.AMPLITUDE)
    kicks = [Kick(j, kind, s * KICK) for kind in kinds for j in range(m) for s in (1, -1)]
    return [None] * base_runs + kicks


def experiments(random, count, kicks, H, c, *, scatter, how="each"):
    """Changes of the responses, and what the fits know of their noise.

    Args:
        random: Generator.
        count: Experiments.
        kicks: Of r runs.
        H: Shape (m, m).
        c: Shape (m,).
        scatter: Standard deviation of each run's phase [rad] and log amplitude.
        how: ``each`` joint by itself, ``common`` to all joints, ``odd``: the second joint five
            times as much, ``drift``: over the experiment, its runs in random order.

    Yields:
        Answers of r runs.
    """
    m = len(c)
    step = np.zeros((len(kicks), m), dtype=complex)
    for k, kick in enumerate(kicks):
        if kick is not None:
            step[k, kick.joint] = kick.size * (1j if kick.kind is KickKind.PHASE else 1.0)
    clean = np.log((c * np.exp(step)) @ H.T / (H @ c))
    shape = clean.shape
    base = [k for k, kick in enumerate(kicks) if kick is None]
    for _ in range(count):
        moved = _complex(random, (shape[0], 1) if how == "common" else shape)
        if how == "odd":
            moved[:, 1] *= 5
        if how == "drift":
            order = random.permutation(shape[0]) / shape[0] - 0.5
            moved = np.sqrt(12) * order[:, None] * (1 + 1j) * np.ones(m)
        log = clean + scatter * moved + NOISE * _complex(random, shape)
        stated = NOISE**2 * random.chisquare(FIT_DOF, (2, *shape)) / FIT_DOF
        yield ResponseMatrices(
            log - log[base].mean(axis=0), stated[0], stated[1], np.full(shape, FIT_DOF)
        )


def row(random, count, m, scatter_deg, *, coupled=True, base_runs=6, how="each", index=True):
    """Return shares of experiments, or of elements of their matrices.

    Returns:
        ``P``, ``R``, ``G``, ``S``: elements whose interval holds the truth; ``worst``: of P's rows
        the worst; ``headline``: experiments in which some element off P's diagonal is shown;
        ``nonlinear``: in which the index excludes 0; ``rows``: in which a sum of rows fails;
        ``half``: median half width of P.
    """
    H, c = chain(m, coupled=coupled)
    L = H * c[None, :] / (H @ c)[:, None]
    truth = {"P": L.real, "R": -L.imag, "G": L.real, "S": L.imag}
    kicks = plan(m, base_runs)
    off = ~np.eye(m, dtype=bool)
    inside = {name: np.zeros((m, m)) for name in truth}
    shown = failed = called = 0
    halves = []
    scatter = np.radians(scatter_deg)
    for answers in experiments(random, count, kicks, H, c, scatter=scatter, how=how):
        result = local_matrices(kicks, answers, amplitude=True)
        for name, value in truth.items():
            matrix = getattr(result, name)
            inside[name] += np.abs(matrix.value - value) <= matrix.half
        shown += bool((np.abs(result.P.value) > result.P.half_together)[off].any())
        failed += not result.agree.all()
        halves.append(np.median(result.P.half))
        if index:
            matrices = (result.P, result.R, result.G, result.S)
            of = nonlinearity(*matrices, correlation=result.errors.correlation)
            called += of.ci95 is not None and of.ci95[0] > 0
    shares = {name: float(hits.mean() / count) for name, hits in inside.items()}
    return {
        **shares,
        "worst": float(inside["P"].mean(axis=1).min() / count),
        "headline": shown / count,
        "nonlinear": called / count,
        "rows": failed / count,
        "half": float(np.median(halves)),
    }


def _complex(random, shape):
    return random.normal(size=shape) + 1j * random.normal(size=shape)


def main():
    """Print the tables."""
    count = 4 if "--quick" in sys.argv else int(sys.argv[1]) if len(sys.argv) > 1 else 300
    random = np.random.default_rng(1)
    print(
        "| joints | scatter | P | R | G | S | worst row of P | half width of P | called nonlinear "
        "| rows fail |\n|---|---|---|---|---|---|---|---|---|---|"
    )
    rows = [(5, s, "each", 6) for s in (0.0, 0.03, 0.1, 0.3)]
    rows += [(5, 0.1, how, 6) for how in ("common", "odd", "drift")]
    rows += [(5, 0.1, "each", 1), (13, 0.1, "each", 6)]
    words = {"each": "", "common": ", common to all joints", "odd": ", one joint five times"}
    words["drift"] = ", a drift"
    for m, scatter, how, base_runs in rows:
        few = count if m < 10 else count // 3
        result = row(random, few, m, scatter, how=how, base_runs=base_runs)
        what = f"{scatter:g}°{words[how]}{', one run without a kick' if base_runs == 1 else ''}"
        shares = " | ".join(f"{100 * result[k]:.1f} %" for k in ("P", "R", "G", "S", "worst"))
        ends = " | ".join(f"{100 * result[k]:.1f} %" for k in ("nonlinear", "rows"))
        print(f"| {m} | {what} | {shares} | {result['half']:.3f} | {ends} |", flush=True)
    print(
        "\n| joints | scatter | coupling shown without any | with it (0.03 to 0.06) |"
        "\n|---|---|---|---|"
    )
    for m, scatter in ((5, 0.0), (5, 0.03), (5, 0.1), (5, 0.3), (13, 0.1)):
        few = 4 * count if m < 10 else count
        none, some = (
            row(random, n, m, scatter, coupled=coupled, index=False)["headline"]
            for n, coupled in ((few, False), (count // 3, True))
        )
        print(f"| {m} | {scatter:g}° | {100 * none:.1f} % | {100 * some:.0f} % |", flush=True)


if __name__ == "__main__":
    main()
