"""The study's conclusions: each an inequality on an end of an interval, evaluated from the rows."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import stdtrit
from scipy.stats import linregress

from .heterogeneity import DRAWS, SOUND, bootstrapped, foretold, short_ratio
from .results import Results

LONG = 13
"""Yaw joints from which on bodies are compared."""


@dataclass(frozen=True)
class Conclusion:
    """A sentence that holds if its inequality does.

    Attributes:
        name: For references from the page.
        sentence: What it says; ``{value}`` stands for value and interval.
        bound: What the interval has to lie above or below.
        above: Whether above.
    """

    name: str
    sentence: str
    bound: float
    above: bool


@dataclass(frozen=True)
class Verdict:
    """A conclusion, evaluated.

    Attributes:
        low: Lower end of the interval.
        high: Upper end.
        holds: None where the rows are too few for it.
    """

    conclusion: Conclusion
    value: float
    low: float
    high: float
    holds: bool | None

    @property
    def expression(self) -> str:
        """Return the inequality with its numbers."""
        end, sign = (self.low, ">") if self.conclusion.above else (self.high, "<")
        return f"{end:.3g} {sign} {self.conclusion.bound:g}"


def _exponent(factor: str) -> Callable[[Results], Sequence[float]]:
    return lambda results: results.exponents["lag_sd"].loc[factor].tolist()


def _boundary_identical(results: Results) -> Sequence[float]:
    alike = results.shares[results.shares["weakened"] == SOUND]["boundary_share"].to_numpy()
    return float(np.median(alike)), float(alike.min()), float(alike.max())


def _named(results: Results) -> Sequence[float]:
    weak = results.shares[results.shares["weakened"] < SOUND]["named"].to_numpy(dtype=float)
    return bootstrapped(weak, np.mean).tolist()


def _worst(
    column: str, pick: Callable[..., float], least: int = 0
) -> Callable[[Results], Sequence[float]]:
    """Return the extreme of a measure over all chains that long, each with its own interval."""

    def of(results: Results) -> Sequence[float]:
        table = results.measures[results.measures["n"] >= least]
        low, high = (table.get(f"{column}_{end}", table[column]) for end in ("low", "high"))
        return pick(table[column]), pick(low), pick(high)

    return of


def _explicit(results: Results) -> Sequence[float]:
    """Explicit coupling that weak servos need, over that of a chain without a body; longest."""
    table = results.measures
    longest = table[table["stall"] == 0.25].sort_values("n").iloc[-1]
    ends = longest[["explicit", "explicit_low", "explicit_high"]].to_numpy(dtype=float)
    return (ends / longest["explicit_alone"]).tolist()


def _time_exponent(kind: str, part: str = "") -> Callable[[Results], Sequence[float]]:
    def of(results: Results) -> Sequence[float]:
        table = results.growth
        row = table[(table["stall"] == 0.25) & (table["kind"] == kind)].iloc[0]
        return [float(row[f"{part}{end}"]) for end in ("value", "low", "high")]

    return of


def _heterogeneity(results: Results) -> Sequence[float]:
    """Median time with the identified body over that with the homogeneous one; longest chain."""
    table = results.chains[results.chains["stall"] == 0.25]
    longest = table[table["n"] == table["n"].max()].set_index("kind")["times"]
    both = np.stack([longest["path + identified"], longest["path + homogeneous"]])
    if table["n"].max() < LONG:
        return np.nan, np.nan, np.nan
    pick = np.random.default_rng(7).integers(0, both.shape[1], (DRAWS, both.shape[1]))
    identified, homogeneous = np.median(both[:, pick], axis=2)
    value = np.median(both[0]) / np.median(both[1])
    return float(value), *np.quantile(identified / homogeneous, (0.025, 0.975)).tolist()


def _beyond_a_wave(results: Results) -> Sequence[float]:
    """Exponent in n of the spread of lag of chains of 9 joints on, Student's interval."""
    table = results.slice("joints")
    table = table[table["n"] >= 9]
    if len(table) < 3:
        return np.nan, np.nan, np.nan
    fit = linregress(np.log(table["n"]), np.log(table["lag_sd"]))
    half = float(stdtrit(len(table) - 2, 0.975) * fit.stderr)
    return fit.slope, fit.slope - half, fit.slope + half


def _rough_across(results: Results) -> Sequence[float]:
    """Distance with the roughest floor across, over that with friction alike both ways."""
    distance = results.slice("friction")["distance_m"].to_numpy(dtype=float)
    return (float(distance[-1] / distance[0]) if len(distance) > 1 else np.nan,) * 3


def _alone(results: Results) -> Sequence[float]:
    """Largest share of starts from which the body alone synchronises a chain."""
    table = results.chains
    share = table[table["kind"] == "identified"]["synchronous"].max()
    return float(share), float(share), float(share)


OF: dict[str, Callable[[Results], Sequence[float]]] = {
    "weak-servos": _exponent("stall_torque"),
    "friction": _exponent("mu_normal"),
    "short-waves": _exponent("lag"),
    "long-chains": _beyond_a_wave,
    "load": lambda results: foretold(results.points).tolist(),
    "rough-across": _rough_across,
    "contact": lambda results: short_ratio(results.contact).tolist(),
    "boundary": _boundary_identical,
    "module": _named,
    "non-normal": _worst("condition", min),
    "not-neighbours": _worst("band1", max, least=9),
    "neutral": _worst("gap", max),
    "never-alone": _alone,
    "linear": _worst("held_out", max),
    "helps": _explicit,
    "path": _time_exponent("path"),
    "body-and-path": _time_exponent("path + identified", "against_"),
    "heterogeneity": _heterogeneity,
}
"""Value and both ends of the 95 % interval of each conclusion."""

CONCLUSIONS = tuple(
    Conclusion(name, **table)
    for name, table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text()).items()
)


def evaluate(results: Results) -> list[Verdict]:
    """Return all conclusions, evaluated."""
    return [_verdict(conclusion, results) for conclusion in CONCLUSIONS]


def _verdict(conclusion: Conclusion, results: Results) -> Verdict:
    value, low, high = (float(x) for x in OF[conclusion.name](results))
    holds = low > conclusion.bound if conclusion.above else high < conclusion.bound
    too_few = not np.isfinite([low, high]).all()
    return Verdict(conclusion, value, low, high, None if too_few else bool(holds))
