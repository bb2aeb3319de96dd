"""Do the modules differ? Run the wave the other way, and the profile must mirror.

Let y_i = ln(a_i / c_i) be the response of driven joint i of m: log gain and, imaginary, minus lag.
Identical modules in a body that is its own mirror image, on level ground whose friction is alike
fore and aft, answer a wave and its reverse with mirrored profiles: y_i(+) = y_{m+1-i}(-), whatever
the free ends do to them. That is H1, and it needs no model. Of several independent runs each way::

    d_i = mean y_i(+) - mean y_{m+1-i}(-)        contrast_i = (d_i - d_{m+1-i}) / 2
                                                 common_i = (d_i + d_{m+1-i}) / 2
    T = max over pairs, gain and lag, of |contrast_i| / se and |common_i| / se

The contrast and the common part of a pair hold all of d_i; a module shows in the contrast, where
both of its joints count, so T finds it more often than the largest d_i does.

On a floor that is tilted the mirror image of a run is the reversed wave of a robot that is turned
by half a turn: a wave and its reverse are compared within strata of runs that are mirror images of
each other, (+, 0) with (-, 180) and (+, 180) with (-, 0), and d_i is the mean of the strata,
weighted by n+ n- / (n+ + n-). Then the tilt cancels whatever its size.

Under H1 a run one way and a mirrored run the other way have the same distribution within a
stratum, so the labels '+' and '-' may be dealt out anew in each stratum: the share of all
labellings whose T is at least the observed one is a p-value that is exact whatever the distribution
of a run, its noise's colour, and the dependence of its joints (Pitman, Suppl. J. Roy. Stat. Soc. 4,
1937); the maximum makes it family-wise (Westfall & Young, *Resampling-Based Multiple Testing*,
1993). Studentised by Welch's errors, of the scatter within the strata, it holds asymptotically
where the two ways are not equally noisy, too (Janssen, Stat. Prob. Letters 36, 1997).

A module that deviates by delta at joint i moves d_i by +delta and d_{m+1-i} by -delta, so the
contrast (d_i - d_{m+1-i}) / 2 orders the pair; a weak module and a strong mirror joint give the
same. What is alike at both joints of a mirror pair, and the middle joint's own deviation, change no
d_i: the test is blind to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, frozen
from undulog.capture.common.errors import UsageError

from ..estimators.intervals import CONFIDENCE, welch_satterthwaite

MOST_LABELLINGS = 20_000
"""Up to so many labellings all are tried; else a random subset."""

RANDOM_LABELLINGS = 9_999
MIN_RUNS = 2
"""Runs each way below which nothing is known of their scatter."""

_TIE = 1e-9
"""Relative difference of two scores that is rounding: the same labelling's, summed otherwise."""


@dataclass(frozen=True)
class MirrorTest:
    """The reversal test of m joints; arrays are read-only.

    Attributes:
        difference: d_i, complex: of log gain and of minus lag [rad], shape (m,).
        error: Standard errors of its real and imaginary part, shape (2, m).
        dof: Their degrees of freedom, after Welch, shape (2, m).
        score: difference / error, shape (2, m).
        critical: Factor on ``error`` that makes all 2 m intervals hold together at 95 %.
        statistic: T.
        contrast: (d_i - d_{m+1-i}) / 2: response of joint i minus that of its mirror joint, mean
            of both ways, complex, shape (m,).
        contrast_error: Standard errors of its parts, shape (2, m).
        contrast_p: p of each contrast after single-step max-T: family-wise over contrasts and
            common parts of all pairs, gain and lag, shape (2, m); 1 of the middle joint.
        common_p: p of each common part (d_i + d_{m+1-i}) / 2, of the same family, shape (2, m).
        strata: How many sets of runs that are mirror images of each other were compared.
        labellings: How many labellings there are.
        tried: How many were tried; all or a random subset.
        floor: The smallest p-value that so many can give.
    """

    difference: ComplexArray
    error: FloatArray
    dof: FloatArray
    score: FloatArray
    critical: float
    statistic: float
    contrast: ComplexArray
    contrast_error: FloatArray
    contrast_p: FloatArray
    common_p: FloatArray
    strata: int
    labellings: int
    tried: int
    floor: float

    @property
    def p(self) -> float:
        """p-value of H1, identical modules."""
        return float(self.joint_p.min())

    @property
    def joint_p(self) -> FloatArray:
        """Family-wise p of each pair, of contrast and common part together, shape (m,)."""
        return np.minimum(self.contrast_p, self.common_p).min(axis=0)

    @property
    def pair_p(self) -> FloatArray:
        """Family-wise p of each pair's contrast, the smaller one of gain and lag, shape (m,)."""
        return self.contrast_p.min(axis=0)


def mirror_test(
    forward: ComplexArray, reverse: ComplexArray, strata: tuple[IntArray, IntArray] | None = None
) -> MirrorTest:
    """Test identical modules by reversal.

    Args:
        forward: y of the runs with the wave one way, shape (r1, m), joints from head to tail.
        reverse: y of the runs the other way, shape (r2, m), joints from head to tail.
        strata: Stratum of each run of either way, shapes (r1,) and (r2,); runs of one stratum are
            mirror images of each other whatever the floor. All runs are in one where it is None.

    Raises:
        UsageError: If a way has fewer than ``MIN_RUNS`` runs in a stratum, or the joints are not
            as many.
    """
    if forward.shape[1:] != reverse.shape[1:] or not forward.shape[1]:
        raise UsageError(
            f"{forward.shape[1]} joints one way and {reverse.shape[1]} the other: the reversal "
            "test needs the same joints both ways"
        )
    r1, r2, m = len(forward), len(reverse), forward.shape[1]
    if min(r1, r2) < MIN_RUNS:
        raise UsageError(
            f"{r1} runs one way and {r2} the other: the reversal test needs "
            f"{MIN_RUNS} each way at least, better 6"
        )
    if strata is None:
        strata = np.zeros(r1, dtype=np.int64), np.zeros(r2, dtype=np.int64)
    design = Strata.of(*strata)
    both = np.concatenate([forward, reverse[:, ::-1]])
    half = m // 2
    # Contrast and common are taken run by run: both joints of a pair share what a run does to all.
    odd, even = (both - both[:, ::-1]) / 2, (both + both[:, ::-1]) / 2
    columns = np.concatenate([parts(odd[:, :half]), parts(even[:, : m - half])], axis=1)
    labels = design.labellings()
    scores = np.abs(design.scores(columns, labels))
    p = family_wise_p(scores)
    noise_only = np.abs(design.scores(design.residuals(parts(both)), labels))
    shares, dof = design.variances(parts(both))
    p_contrast, p_common = np.ones((2, m)), np.ones((2, m))
    p_contrast[:, :half] = p[: 2 * half].reshape(2, half)
    p_common[:, : m - half] = p[2 * half :].reshape(2, m - half)
    for of_pair in (p_contrast, p_common):
        of_pair[:, m - half :] = of_pair[:, :half][:, ::-1]
    difference = design.difference(both)
    total = design.count
    every = total <= MOST_LABELLINGS
    return MirrorTest(
        difference=frozen(difference),
        error=frozen(np.sqrt(shares.sum(axis=0)).reshape(2, m)),
        dof=frozen(welch_satterthwaite(shares, dof).reshape(2, m)),
        score=frozen(design.scores(parts(both), labels[:1])[0].reshape(2, m)),
        critical=float(np.quantile(noise_only.max(axis=-1), CONFIDENCE, method="higher")),
        statistic=float(scores[0].max()),
        contrast=frozen((difference - difference[::-1]) / 2),
        contrast_error=frozen(np.sqrt(design.variances(parts(odd))[0].sum(axis=0)).reshape(2, m)),
        contrast_p=frozen(p_contrast),
        common_p=frozen(p_common),
        strata=design.strata,
        labellings=total,
        tried=total if every else len(labels),
        floor=(2 if design.symmetric else 1) / total if every else 1 / len(labels),
    )


@dataclass(frozen=True)
class Strata:
    """Which runs are compared with which.

    Attributes:
        index: Stratum of each run, from 0, those of the one way first, shape (r1 + r2,).
        plus: Runs one way in each stratum, shape (s,).
        minus: Runs the other way, shape (s,).
    """

    index: IntArray
    plus: IntArray
    minus: IntArray

    @classmethod
    def of(cls, forward: IntArray, reverse: IntArray) -> Self:
        """Count the runs of each stratum.

        Args:
            forward: Stratum of each run one way, any integers, shape (r1,).
            reverse: Stratum of each run the other way, shape (r2,).

        Raises:
            UsageError: If a stratum has fewer than ``MIN_RUNS`` runs of a way.
        """
        _, index = np.unique(np.concatenate([forward, reverse]), return_inverse=True)
        count = int(index.max()) + 1
        plus = np.bincount(index[: len(forward)], minlength=count)
        minus = np.bincount(index[len(forward) :], minlength=count)
        if min(plus.min(), minus.min()) < MIN_RUNS:
            raise UsageError(
                f"a stratum has fewer than {MIN_RUNS} runs of a way: {plus.tolist()} one way and "
                f"{minus.tolist()} the other"
            )
        return cls(index, plus, minus)

    @property
    def strata(self) -> int:
        """How many there are."""
        return len(self.plus)

    @property
    def count(self) -> int:
        """How many labellings there are."""
        pairs = zip(self.plus.tolist(), self.minus.tolist(), strict=True)
        return math.prod(math.comb(plus + minus, plus) for plus, minus in pairs)

    @property
    def symmetric(self) -> bool:
        """Whether to call every run the other way gives a labelling, too."""
        return bool((self.plus == self.minus).all())

    @property
    def weights(self) -> FloatArray:
        """Weight of each stratum's difference, shape (s,)."""
        precision = self.plus * self.minus / (self.plus + self.minus)
        return precision / precision.sum()

    def labellings(self) -> BoolArray:
        """Return ways to choose which runs of each stratum are called '+'.

        Returns:
            True for '+', shape (k, r1 + r2), the observed labelling first. All of them, but where
            every stratum has as many of both ways one of each two that differ by the sign of every
            d_i alone; a random subset where they are more than ``MOST_LABELLINGS``, which gives a
            valid p-value too, since the observed one is among it (Phipson & Smyth, Stat. Appl.
            Genet. Mol. Biol. 9, 2010).
        """
        observed = np.arange(len(self.index)) < int(self.plus.sum())
        stratum_runs: list[IntArray] = [np.flatnonzero(self.index == s) for s in range(self.strata)]
        if self.count > MOST_LABELLINGS:
            random = np.random.default_rng(1)
            drawn = np.zeros((RANDOM_LABELLINGS, len(self.index)), dtype=np.bool_)
            for runs, plus in zip(stratum_runs, self.plus.tolist(), strict=True):
                order = random.random((RANDOM_LABELLINGS, len(runs))).argsort(axis=1)
                drawn[:, runs] = order.argsort(axis=1) < plus
            return np.concatenate([observed[None], drawn])
        labels = np.zeros((1, len(self.index)), dtype=np.bool_)
        for s, (runs, plus) in enumerate(zip(stratum_runs, self.plus.tolist(), strict=True)):
            members: list[int] = runs.tolist()
            chosen: IntArray = np.array(list(combinations(members, int(plus))), dtype=np.int64)
            if s == 0 and self.symmetric:
                chosen = chosen[: len(chosen) // 2]  # those with the first run in '+'
            part = np.zeros((len(chosen), len(self.index)), dtype=np.bool_)
            np.put_along_axis(part, chosen, values=True, axis=1)
            labels = (labels[:, None] | part[None]).reshape(-1, len(self.index))
        return labels  # combinations come in order, so the first is the observed one

    def scores(self, runs: FloatArray, labels: BoolArray) -> FloatArray:
        """Return the studentised difference of the runs called '+' and the others.

        Args:
            runs: Those of the one way first, sets of them in the leading axes, shape (..., r, c).
            labels: True for '+', with the same numbers in each stratum, shape (k, r).

        Returns:
            Difference over its standard error, shape (..., k, c). Of one stratum
            (mean '+' - mean others) / sqrt(s1^2 / r1 + s2^2 / r2). 0 where all runs of each
            stratum agree to the bit; finite where they agree but for their label.
        """
        stratum_rows = [np.flatnonzero(self.index == s) for s in range(self.strata)]
        # The first of all subtracted first, so that runs that agree give exact zeros.
        centred = [runs[..., rows, :] - runs[..., rows[:1], :] for rows in stratum_rows]
        centred = [stratum - stratum.mean(axis=-2, keepdims=True) for stratum in centred]
        size = np.sqrt(sum(np.sum(stratum**2, axis=-2, keepdims=True) for stratum in centred))
        counts = np.stack([self.plus, self.minus])
        difference = within1 = within2 = np.zeros(1)
        for s, (rows, stratum) in enumerate(zip(stratum_rows, centred, strict=True)):
            r1, r2 = counts[:, s].tolist()
            z = np.divide(stratum, size, out=np.zeros_like(stratum), where=size > 0)
            # All sums from those of '+' alone: z sums to 0 in a stratum.
            plus = labels[:, rows].astype(np.float64)
            first, squares = plus @ z, plus @ z**2
            within1 = within1 + squares - first**2 / r1
            within2 = within2 + np.sum(z**2, axis=-2, keepdims=True) - squares - first**2 / r2
            difference = difference + self.weights[s] * first * (1 / r1 + 1 / r2)
        spread1, spread2 = np.sum(self.weights**2 / counts, axis=1)
        dof1, dof2 = np.sum(counts - 1.0, axis=1)
        variance = within1 / dof1 * spread1 + within2 / dof2 * spread2
        return difference / np.sqrt(np.maximum(variance, np.finfo(np.float64).eps))

    def difference(self, runs: ComplexArray) -> ComplexArray:
        """Return the weighted mean of the strata's differences of '+' and '-'.

        Args:
            runs: Those of the one way first, shape (r, c).

        Returns:
            Shape (c,).
        """
        plus = np.arange(len(runs)) < int(self.plus.sum())
        differences = [
            runs[(self.index == s) & plus].mean(axis=0)
            - runs[(self.index == s) & ~plus].mean(axis=0)
            for s in range(self.strata)
        ]
        return (self.weights[:, None] * np.stack(differences)).sum(axis=0)

    def residuals(self, runs: FloatArray) -> FloatArray:
        """Subtract the mean of each run's way in its stratum.

        Args:
            runs: Those of the one way first, shape (r, c).

        Returns:
            The same shape.
        """
        cell = 2 * self.index + (np.arange(len(runs)) >= int(self.plus.sum()))
        out = runs.copy()
        for number in np.unique(cell):
            out[cell == number] -= runs[cell == number].mean(axis=0)
        return out

    def variances(self, runs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variance that each way adds to the difference, from the scatter in strata.

        Args:
            runs: Those of the one way first, shape (r, c).

        Returns:
            The variances and their degrees of freedom, both of shape (2, c).
        """
        squares = self.residuals(runs) ** 2
        r1 = int(self.plus.sum())
        counts = np.stack([self.plus, self.minus])
        dof = np.sum(counts - 1.0, axis=1)[:, None]
        spread = np.sum(self.weights**2 / counts, axis=1)[:, None]
        totals: FloatArray = np.stack([squares[:r1].sum(axis=0), squares[r1:].sum(axis=0)])
        return totals / dof * spread, np.broadcast_to(dof, totals.shape)


def parts(y: ComplexArray) -> FloatArray:
    """Join log gain and minus lag.

    Args:
        y: Complex, shape (..., m).

    Returns:
        Shape (..., 2 m).
    """
    return np.concatenate([y.real, y.imag], axis=-1)


def family_wise_p(scores: FloatArray) -> FloatArray:
    """Return single-step max-T p-values.

    Args:
        scores: abs(t) of k labellings and c quantities, the observed labelling first, shape
            (..., k, c).

    Returns:
        Share of the labellings whose largest abs(t) reaches each observed abs(t), shape (..., c).
    """
    return np.mean(scores.max(axis=-1)[..., :, None] >= scores[..., :1, :] * (1 - _TIE), axis=-2)
