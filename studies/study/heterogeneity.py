"""Part (a): what makes the joints of a chain respond unequally, from the rows of the sweeps."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from undulog.analysis.experiment.reversal import variance_shares
from undulog.capture.common.arrays import FloatArray
from undulog.replay.sweep.plan import points_of, read_plan

from .design import PLANS
from .rows import responses

LINK_M, LINK_KG, GRAVITY = 0.06, 0.1, 9.81
SUPPLY_V, TORQUE_CONSTANT, VISCOUS, INERTIA = 6.0, 1.0, 0.005, 1.5e-3
"""Of the links and servos of ``plans/chain.toml``."""
SOUND = 8.0
"""Gain of the modules that are not weakened [1/rad]."""
MOST_DRIFT = 0.01
"""Rows whose response drifts by more per cycle (log gain or rad) are not settled, and left out."""
DRAWS = 1000
OUTCOMES = {"lag_sd": "spread of lag", "gain_cv": "CV of gain"}
FACTORS = ("stall_torque", "proportional_gain", "mu_normal", "mu_tangential", "n", "lag")
FACTORS = (*FACTORS, "amplitude", "frequency_hz")
LAWS = ("box", "transeth")
"""Against the ellipse."""


def settled(rows: pd.DataFrame, plan: str) -> pd.DataFrame:
    """Return the rows of a sweep that are done, settled and have a spread."""
    done = rows[(rows["plan"] == plan) & (rows["status"] == "done")]
    return done[(done["drift"] <= MOST_DRIFT) & (done["lag_sd"] > 0.0) & (done["gain_cv"] > 0)]


def contact_points(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the settled points in contact: of the Sobol design, and of that without ground."""
    both = pd.concat([settled(rows, "sobol"), settled(rows, "pair-ground")], ignore_index=True)
    return both.fillna({"law": "ellipse", "mu_normal": 0.5, "mu_tangential": 0.05})


def power_law(points: pd.DataFrame) -> FloatArray:
    """Return regressors: 1, logs of the factors, the laws; shape (points, 11)."""
    logs = np.log(points[list(FACTORS)].to_numpy(dtype=float))
    laws = [(points["law"] == law).to_numpy(dtype=float)[:, None] for law in LAWS]
    return np.hstack([np.ones((len(points), 1)), logs, *laws])


def hump(points: pd.DataFrame) -> FloatArray:
    """Return regressors of a hump in n whose place depends on the lag; shape (points, 2).

    A chain much shorter than a wave and one much longer are both more alike than one of a wave.
    """
    n, lag = (np.log(points[name].to_numpy(dtype=float)) for name in ("n", "lag"))
    n, lag = n - n.mean(), lag - lag.mean()
    return np.stack([n**2, n * lag], axis=1)


def design(points: pd.DataFrame) -> FloatArray:
    """Return regressors of the power law with the hump, shape (points, 13)."""
    return np.hstack([power_law(points), hump(points)])


def exponents(points: pd.DataFrame, outcome: str) -> pd.DataFrame:
    """Return exponents of each factor with 95 % intervals by bootstrap over points.

    Those of n and lag hold at the points' geometric means; of the laws they are logarithms of the
    factor against the ellipse.
    """
    X, y = design(points), np.log(points[outcome].to_numpy())
    random = np.random.default_rng(1)
    drawn = []
    for _ in range(DRAWS):
        pick = random.integers(0, len(y), len(y))
        drawn.append(np.linalg.lstsq(X[pick], y[pick], rcond=None)[0])
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
    value = np.linalg.lstsq(X, y, rcond=None)[0]
    table = pd.DataFrame({"value": value, "low": low, "high": high})
    return table.set_index(pd.Index(["constant", *FACTORS, *LAWS, "n n", "n lag"]))


def _friction(p: pd.DataFrame) -> FloatArray:
    return (p["mu_normal"] * LINK_KG * GRAVITY * LINK_M).to_numpy(dtype=float)


def _stiffness(p: pd.DataFrame) -> FloatArray:
    return (p["proportional_gain"] * p["stall_torque"]).to_numpy(dtype=float)


def _omega(p: pd.DataFrame) -> FloatArray:
    return 2.0 * np.pi * p["frequency_hz"].to_numpy(dtype=float)


def _inertial(p: pd.DataFrame) -> FloatArray:
    return _omega(p) ** 2 * LINK_KG * LINK_M**2


def _time_constant(p: pd.DataFrame) -> FloatArray:
    """Of the servo alone: (Kt^2/R + b) / (Kp stall torque) [s]."""
    damping = p["stall_torque"].to_numpy(dtype=float) * TORQUE_CONSTANT / SUPPLY_V + VISCOUS
    return damping / _stiffness(p)


TWO_LOADS = "√(μ_n m g L · ω² m L²) / (√A K_p T_s)"
GROUPS: Mapping[str, Callable[[pd.DataFrame], FloatArray]] = {
    "T_s / (μ_n m g L)": lambda p: p["stall_torque"].to_numpy(dtype=float) / _friction(p),
    "K_p T_s / (μ_n m g L)": lambda p: _stiffness(p) / _friction(p),
    "A K_p T_s / (μ_n m g L)": lambda p: p["amplitude"] * _stiffness(p) / _friction(p),
    "ω t_s": lambda p: _omega(p) * _time_constant(p),
    "ω² m L² / (K_p T_s)": lambda p: _inertial(p) / _stiffness(p),
    TWO_LOADS: lambda p: (
        np.sqrt(_friction(p) * _inertial(p)) / _stiffness(p) / np.sqrt(p["amplitude"])
    ),
    "n φ / 2π": lambda p: p["n"] * p["lag"] / (2.0 * np.pi),
    "2π / φ": lambda p: 2.0 * np.pi / p["lag"],
    "μ_n / μ_t": lambda p: p["mu_normal"] / p["mu_tangential"],
}
"""Dimensionless groups; T_s is the stall torque, t_s the time constant of the servo alone, n φ / 2π
the waves on the body."""

KNOWN = {"sobol": 32, "pair-ground": 16}
FEWEST = 30
"""Points before and after, below which nothing is foretold."""
SHAPE, ALL = " + shape", "all factors"
SCALED = "A K_p T_s / (μ_n m g L n^p)"
POWERS = np.arange(-1.0, 2.01, 0.25)


def group_fits(points: pd.DataFrame, outcome: str) -> pd.DataFrame:
    """Return R^2 out of sample, with intervals, of models of one group and of all factors.

    Groups alone enter as quadratics of their logarithms; beside n, lag and the hump (NAME + shape)
    as powers. Of ``A K_p T_s / (μ_n m g L n^p)`` p is chosen within each training set.
    """
    y = np.log(points[outcome].to_numpy())
    logs = {name: np.log(np.asarray(of(points), dtype=float)) for name, of in GROUPS.items()}
    n, shape = np.log(points["n"].to_numpy(dtype=float)), _shape(points)
    rows = {name: held_out([quadratic(x)], y) for name, x in logs.items()}
    rows |= {name + SHAPE: held_out([np.column_stack([shape, x])], y) for name, x in logs.items()}
    load = logs["A K_p T_s / (μ_n m g L)"]
    rows[SCALED] = held_out([quadratic(load - p * n) for p in POWERS], y)
    rows[ALL] = held_out([power_law(points)], y)
    rows["none" + SHAPE] = held_out([shape], y)
    rows[ALL + SHAPE] = held_out([design(points)], y)
    return pd.DataFrame(rows, index=["value", "low", "high"]).T


def foretold(points: pd.DataFrame) -> FloatArray:
    """Return R^2, with its interval, of later points' ln spread by the group of both loads.

    The group was made up when ``KNOWN`` points had been run, and the model is fitted to these.
    """
    early_points = {
        json.dumps(point, sort_keys=True)
        for name, count in KNOWN.items()
        for point in points_of(replace(read_plan(PLANS / f"{name}.toml"), points=count))
    }
    early = points["changes"].isin(early_points).to_numpy()
    if min(early.sum(), (~early).sum()) < FEWEST:
        return np.full(3, np.nan)
    y = np.log(points["lag_sd"].to_numpy())
    X = np.column_stack([_shape(points), np.log(GROUPS[TWO_LOADS](points))])
    fit = np.linalg.lstsq(X[early], y[early], rcond=None)[0]
    return _explained((y - X @ fit)[~early], y[~early] - y[early].mean())


def _shape(points: pd.DataFrame) -> FloatArray:
    logs = np.log(points[["n", "lag"]].to_numpy(dtype=float))
    return np.column_stack([np.ones(len(points)), logs, hump(points)])


def _explained(error: FloatArray, spread: FloatArray) -> FloatArray:
    """Return R^2 and its 95 % interval by bootstrap over points, shape (3,)."""
    pick = np.random.default_rng(3).integers(0, len(error), (DRAWS, len(error)))
    drawn = 1.0 - np.sum(error[pick] ** 2, axis=1) / np.sum(spread[pick] ** 2, axis=1)
    value = 1.0 - np.sum(error**2) / np.sum(spread**2)
    return np.array([value, *np.quantile(drawn, (0.025, 0.975))])


def quadratic(*logs: FloatArray) -> FloatArray:
    """Return regressors 1, each logarithm, and their products."""
    squares = [a * b for k, a in enumerate(logs) for b in logs[k:]]
    return np.stack([np.ones(len(logs[0])), *logs, *squares], axis=1)


def held_out(models: list[FloatArray], y: FloatArray, folds: int = 10) -> FloatArray:
    """Return R^2 out of sample and its 95 % interval by bootstrap over points, shape (3,)."""
    fold = np.random.default_rng(2).permutation(np.arange(len(y)) % folds)
    error, spread = np.empty(len(y)), np.empty(len(y))
    for k in range(folds):
        train = fold != k
        fits = [np.linalg.lstsq(X[train], y[train], rcond=None)[0] for X in models]
        left = [np.sum((y[train] - X[train] @ b) ** 2) for X, b in zip(models, fits, strict=True)]
        best = int(np.argmin(left))
        error[~train] = y[~train] - models[best][~train] @ fits[best]
        spread[~train] = y[~train] - y[train].mean()
    return _explained(error, spread)


def shares(rows: pd.DataFrame) -> pd.DataFrame:
    """Return what reversal says of each point: shares, mismatch, and which pair stands out.

    The twin has no noise here, so one run each way is the mean.
    """
    both = _paired(rows, "reversal-forward", "reversal-back")
    records = []
    for forward, back in zip(responses(both[0]), responses(both[1]), strict=True):
        parts = variance_shares(np.stack([forward, forward]), np.stack([back, back]))
        d = forward - back[::-1]
        contrast = np.abs(d - d[::-1])[: len(d) // 2]
        records.append(
            {
                "n": len(forward),
                "boundary_share": 1.0 - (parts.module_share.value or 0.0),
                "module_variance": parts.module_variance,
                "mismatch": float(np.abs(d).max()),
                "named": int(np.argmax(contrast)) == 1,  # joint03 is the second yaw joint
            }
        )
    table = pd.DataFrame(records)
    return table.assign(
        **{name: both[0][name].to_numpy() for name in ("weakened", "stall_torque", "lag_sd", "key")}
    )


def contact(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the spread of lag with contact and without, of the points settled in both."""
    ground, free = _paired(rows, "pair-ground", "pair-free")
    names = ["n", "stall_torque", "proportional_gain", "lag", "frequency_hz", "key"]
    both = ground[names].assign(ground=ground["lag_sd"], free=free["lag_sd"].to_numpy())
    return both.assign(ratio=both["ground"] / both["free"])


SHORT = 9
"""Yaw joints up to which bending modes lie above the design's gaits."""


def short_ratio(table: pd.DataFrame) -> FloatArray:
    """Return the median ratio of chains up to ``SHORT`` joints, with its interval, shape (3,)."""
    return bootstrapped(table.loc[table["n"] <= SHORT, "ratio"].to_numpy())


def _paired(rows: pd.DataFrame, first: str, other: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the settled rows of two sweeps over the same points, in the same order."""
    a, b = (settled(rows, name).set_index("changes").sort_index() for name in (first, other))
    common = a.index.intersection(b.index)
    return a.loc[common].reset_index(), b.loc[common].reset_index()


def bootstrapped(values: FloatArray, of: Callable[..., FloatArray] = np.median) -> FloatArray:
    """Return a statistic and its 95 % percentile interval by bootstrap, shape (3,)."""
    values = np.asarray(values, dtype=float)
    pick = np.random.default_rng(4).integers(0, len(values), (DRAWS, len(values)))
    return np.array([of(values), *np.quantile(of(values[pick], axis=1), (0.025, 0.975))])
