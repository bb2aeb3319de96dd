"""The study's conclusions: each an inequality on an end of an interval, evaluated from the rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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
        of: Value and both ends of the 95 % interval, of the results.
    """

    name: str
    sentence: str
    bound: float
    above: bool
    of: Callable[[Results], Sequence[float]]


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


def _exponent(outcome: str, factor: str) -> Callable[[Results], Sequence[float]]:
    return lambda results: results.exponents[outcome].loc[factor].tolist()


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
    one = table[table["stall"] == 0.25].sort_values("n").iloc[-1]
    ends = one[["explicit", "explicit_low", "explicit_high"]].to_numpy(dtype=float)
    return (ends / one["explicit_alone"]).tolist()


def _time_exponent(kind: str, part: str = "") -> Callable[[Results], Sequence[float]]:
    def of(results: Results) -> Sequence[float]:
        table = results.growth
        one = table[(table["stall"] == 0.25) & (table["kind"] == kind)].iloc[0]
        return [float(one[f"{part}{end}"]) for end in ("value", "low", "high")]

    return of


def _heterogeneity(results: Results) -> Sequence[float]:
    """Median time with the identified body over that with the homogeneous one; longest chain."""
    table = results.chains[results.chains["stall"] == 0.25]
    longest = table[table["n"] == table["n"].max()].set_index("kind")["times"]
    both = np.stack([longest["path + identified"], longest["path + homogeneous"]])
    if table["n"].max() < LONG:
        return np.nan, np.nan, np.nan
    pick = np.random.default_rng(7).integers(0, both.shape[1], (DRAWS, both.shape[1]))
    one, other = np.median(both[:, pick], axis=2)
    value = np.median(both[0]) / np.median(both[1])
    return float(value), *np.quantile(one / other, (0.025, 0.975)).tolist()


def _beyond_a_wave(results: Results) -> Sequence[float]:
    """Exponent in n of the spread of lag of chains of 9 joints on, Student's interval."""
    table = results.slice("joints")
    table = table[table["n"] >= 9]
    if len(table) < 3:
        return np.nan, np.nan, np.nan
    found = linregress(np.log(table["n"]), np.log(table["lag_sd"]))
    half = float(stdtrit(len(table) - 2, 0.975) * found.stderr)
    return found.slope, found.slope - half, found.slope + half


def _rough_across(results: Results) -> Sequence[float]:
    """Distance with the roughest floor across, over that with friction alike both ways."""
    distance = results.slice("friction")["distance_m"].to_numpy(dtype=float)
    return (float(distance[-1] / distance[0]) if len(distance) > 1 else np.nan,) * 3


def _load_group(results: Results) -> Sequence[float]:
    return foretold(results.points).tolist()


def _alone(results: Results) -> Sequence[float]:
    """Largest share of starts from which the body alone synchronises a chain."""
    table = results.chains
    share = table[table["kind"] == "identified"]["synchronous"].max()
    return float(share), float(share), float(share)


CONCLUSIONS = (
    Conclusion(
        "weak-servos",
        "Weak servos make joints unequal: the spread of lag goes as stall torque to the {value}.",
        0.0,
        above=False,
        of=_exponent("lag_sd", "stall_torque"),
    ),
    Conclusion(
        "friction",
        "Friction across the body makes joints unequal: the spread of lag goes as mu_n to the "
        "{value}.",
        0.0,
        above=True,
        of=_exponent("lag_sd", "mu_normal"),
    ),
    Conclusion(
        "short-waves",
        "Long waves make joints unequal: the spread of lag goes as the lag between joints to "
        "the {value}.",
        0.0,
        above=False,
        of=_exponent("lag_sd", "lag"),
    ),
    Conclusion(
        "long-chains",
        "From 9 joints on longer chains are less unequal, since the ends keep their size: the "
        "spread "
        "of lag goes as n to the {value}.",
        0.0,
        above=False,
        of=_beyond_a_wave,
    ),
    Conclusion(
        "load",
        "Shape, and friction and inertia together over the servo's stiffness, foretell {value} of "
        "the variance of ln spread of points that were run later.",
        0.3,
        above=True,
        of=_load_group,
    ),
    Conclusion(
        "rough-across",
        "It is friction across that moves the robot: it goes {value} times as far with the "
        "roughest floor "
        "across as with friction alike both ways.",
        5.0,
        above=True,
        of=_rough_across,
    ),
    Conclusion(
        "contact",
        "Up to 9 joints it is contact that makes them unequal: with it the spread of lag is "
        "{value} times as large.",
        2.0,
        above=True,
        of=lambda results: short_ratio(results.contact).tolist(),
    ),
    Conclusion(
        "boundary",
        "Of identical modules reversal gives the boundary all of the spread: a share of {value}.",
        0.99,
        above=True,
        of=_boundary_identical,
    ),
    Conclusion(
        "module",
        "The pair of a weak module has the largest contrast in a share of {value} of the points.",
        0.5,
        above=True,
        of=_named,
    ),
    Conclusion(
        "non-normal",
        "P is not normal: an error of P can move the rates at least {value} times as far.",
        2.0,
        above=True,
        of=_worst("condition", min),
    ),
    Conclusion(
        "not-neighbours",
        "From 9 joints on next neighbours hold at most {value} of the off-diagonal energy of P.",
        0.7,
        above=False,
        of=_worst("band1", max, least=9),
    ),
    Conclusion(
        "neutral",
        "The body alone leaves a pattern to itself or drives it: the slowest rate is at most "
        "{value} eps.",
        0.02,
        above=False,
        of=_worst("gap", max),
    ),
    Conclusion(
        "never-alone",
        "The body alone synchronises no chain: from a share of {value} of the starts.",
        0.5,
        above=False,
        of=_alone,
    ),
    Conclusion(
        "linear",
        "P predicts random patterns of 0.1 rad: its error is at most {value} of that of "
        "joints that "
        "keep their response.",
        0.5,
        above=False,
        of=_worst("held_out", max),
    ),
    Conclusion(
        "helps",
        "With weak servos the body spares explicit coupling: the longest chain needs {value} "
        "of what "
        "it needs without a body.",
        1.0,
        above=False,
        of=_explicit,
    ),
    Conclusion(
        "path",
        "A path of next neighbours takes a time to synchronise that grows as n to the {value}.",
        1.3,
        above=True,
        of=_time_exponent("path"),
    ),
    Conclusion(
        "body-and-path",
        "With weak servos the identified body beside the path changes that exponent by {value}.",
        0.0,
        above=False,
        of=_time_exponent("path + identified", "against_"),
    ),
    Conclusion(
        "heterogeneity",
        "The longest chain of weak servos takes {value} times as long with the body as it is as "
        "with a homogeneous one of the same strength.",
        1.0,
        above=True,
        of=_heterogeneity,
    ),
)


def evaluate(results: Results) -> list[Verdict]:
    """Return all conclusions, evaluated."""
    return [_verdict(one, results) for one in CONCLUSIONS]


def _verdict(one: Conclusion, results: Results) -> Verdict:
    value, low, high = (float(x) for x in one.of(results))
    holds = low > one.bound if one.above else high < one.bound
    too_few = not np.isfinite([low, high]).all()
    return Verdict(one, value, low, high, None if too_few else bool(holds))
