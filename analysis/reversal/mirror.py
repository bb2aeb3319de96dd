"""Do the modules differ? Run the wave the other way, and the profile must mirror.

Let y_i = ln(a_i / c_i) be the response of driven joint i of m: log gain and, imaginary, minus lag.
Identical modules in a body that is its own mirror image, on level ground whose friction is alike
fore and aft, answer a wave and its reverse with mirrored profiles: y_i(+) = y_{m+1-i}(-), whatever
the free ends do to them. That is H1, and it needs no model. Of several independent runs each way::

    d_i = mean y_i(+) - mean y_{m+1-i}(-)        T = max over i, gain and lag, of |d_i| / se(d_i)

Under H1 a run one way and a mirrored run the other way have the same distribution, so the labels
'+' and '-' may be dealt out anew: the share of all labellings whose T is at least the observed one
is a p-value that is exact whatever the distribution of a run, its noise's colour, and the
dependence of its joints (Pitman, Suppl. J. Roy. Stat. Soc. 4, 1937); the maximum makes it
family-wise (Westfall & Young, *Resampling-Based Multiple Testing*, 1993). Studentised by Welch's
errors it holds asymptotically where the two ways are not equally noisy, too (Janssen, Stat. Prob.
Letters 36, 1997).

A module that deviates by delta at joint i moves d_i by +delta and d_{m+1-i} by -delta, so the sign
names the joint. What is alike at both joints of a mirror pair, and the middle joint's own
deviation, change no d_i: the test is blind to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from capture.arrays import BoolArray, ComplexArray, FloatArray, frozen
from capture.errors import UsageError

from ..response import CONFIDENCE, welch_satterthwaite

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
        p_adjusted: Family-wise p of each, after single-step max-T, shape (2, m).
        critical: Factor on ``error`` that makes all 2 m intervals hold together at 95 %.
        contrast: (d_i - d_{m+1-i}) / 2: response of joint i minus that of its mirror joint, mean
            of both ways, complex, shape (m,).
        contrast_error: Standard errors of its parts, shape (2, m).
        labellings: How many labellings there are.
        tried: How many were tried; all or a random subset.
        floor: The smallest p-value that so many can give.
    """

    difference: ComplexArray
    error: FloatArray
    dof: FloatArray
    score: FloatArray
    p_adjusted: FloatArray
    critical: float
    contrast: ComplexArray
    contrast_error: FloatArray
    labellings: int
    tried: int
    floor: float

    @property
    def statistic(self) -> float:
        """T."""
        return float(np.abs(self.score).max())

    @property
    def p(self) -> float:
        """p-value of H1, identical modules."""
        return float(self.p_adjusted.min())

    @property
    def exact(self) -> bool:
        """Whether all labellings were tried."""
        return self.tried == self.labellings

    @property
    def pair_p(self) -> FloatArray:
        """Family-wise p of each joint and its mirror joint together, shape (m,)."""
        own = self.p_adjusted.min(axis=0)
        return np.minimum(own, own[::-1])

    @property
    def common(self) -> ComplexArray:
        """(d_i + d_{m+1-i}) / 2: what both joints of a pair do otherwise the other way, (m,)."""
        return (self.difference + self.difference[::-1]) / 2


def mirror_test(forward: ComplexArray, reverse: ComplexArray, seed: int = 1) -> MirrorTest:
    """Test identical modules by reversal.

    Args:
        forward: y of the runs with the wave one way, shape (r1, m), joints from head to tail.
        reverse: y of the runs the other way, shape (r2, m), joints from head to tail.
        seed: Of the random labellings, where there are too many to try all.

    Returns:
        The test.

    Raises:
        UsageError: If a way has fewer than ``MIN_RUNS`` runs, or the joints are not as many.
    """
    if forward.shape[1:] != reverse.shape[1:] or not forward.shape[1]:
        raise UsageError(
            f"{forward.shape[1]} joints one way and {reverse.shape[1]} the other: the reversal "
            "test needs the same joints both ways"
        )
    if min(len(forward), len(reverse)) < MIN_RUNS:
        raise UsageError(
            f"{len(forward)} runs one way and {len(reverse)} the other: the reversal test needs "
            f"{MIN_RUNS} each way at least, better 6"
        )
    mirrored = reverse[:, ::-1]
    runs = parts(np.concatenate([forward, mirrored]))
    r1, r2 = len(forward), len(reverse)
    labels = labellings(r1, r2, seed)
    scores = np.abs(label_scores(runs, labels))
    resid = runs.copy()
    resid[:r1] -= runs[:r1].mean(axis=0)
    resid[r1:] -= runs[r1:].mean(axis=0)
    noise_only = np.abs(label_scores(resid, labels)).max(axis=-1)
    shares = np.stack([_mean_variance(runs[:r1]), _mean_variance(runs[r1:])])
    runs_dof = np.broadcast_to(np.array([[r1 - 1.0], [r2 - 1.0]]), shares.shape)
    difference = forward.mean(axis=0) - mirrored.mean(axis=0)
    # By pairs, since both joints of a pair share what a run does to all joints alike.
    odd = [parts((one - one[:, ::-1]) / 2) for one in (forward, reverse)]
    total = math.comb(r1 + r2, r1)
    doubled = 2 if r1 == r2 else 1
    every = total <= MOST_LABELLINGS
    m = forward.shape[1]
    return MirrorTest(
        difference=frozen(difference),
        error=frozen(np.sqrt(shares.sum(axis=0)).reshape(2, m)),
        dof=frozen(welch_satterthwaite(shares, runs_dof).reshape(2, m)),
        score=frozen(label_scores(runs, labels[:1])[0].reshape(2, m)),
        p_adjusted=frozen(family_wise_p(scores).reshape(2, m)),
        critical=float(np.quantile(noise_only, CONFIDENCE, method="higher")),
        contrast=frozen((difference - difference[::-1]) / 2),
        contrast_error=frozen(np.sqrt(sum(map(_mean_variance, odd))).reshape(2, m)),
        labellings=total,
        tried=total if every else len(labels),
        floor=doubled / total if every else 1 / len(labels),
    )


def parts(y: ComplexArray) -> FloatArray:
    """Log gain and minus lag side by side.

    Args:
        y: Complex, shape (..., m).

    Returns:
        Shape (..., 2 m).
    """
    return np.concatenate([y.real, y.imag], axis=-1)


def labellings(r1: int, r2: int, seed: int = 1) -> BoolArray:
    """Ways to choose which r1 of the r1 + r2 runs are called '+'.

    Args:
        r1: Runs one way.
        r2: Runs the other way.
        seed: Of a random subset.

    Returns:
        True for '+', shape (k, r1 + r2), the observed labelling first. All of them, but where
        r1 = r2 one of each two that differ by the sign of every d_i alone; a random subset where
        they are more than ``MOST_LABELLINGS``, which gives a valid p-value too, since the observed
        one is among it (Phipson & Smyth, Stat. Appl. Genet. Mol. Biol. 9, 2010).
    """
    count = r1 + r2
    observed = np.arange(count) < r1
    total = math.comb(count, r1)
    if total <= MOST_LABELLINGS:
        chosen = np.array(list(combinations(range(count), r1)), dtype=np.int64)
        chosen = chosen[: total // 2] if r1 == r2 else chosen  # those with the first run in '+'
        labels = np.zeros((len(chosen), count), dtype=np.bool_)
        np.put_along_axis(labels, chosen, values=True, axis=1)
        return labels  # combinations come in order, so the first is the observed one
    random = np.random.default_rng(seed).random((RANDOM_LABELLINGS, count))
    drawn: BoolArray = random.argsort(axis=1).argsort(axis=1) < r1
    return np.concatenate([observed[None], drawn])


def label_scores(runs: FloatArray, labels: BoolArray) -> FloatArray:
    """Studentised difference of the means of the runs called '+' and the others.

    Args:
        runs: Shape (..., r, c): r runs of c quantities, sets of them in the leading axes.
        labels: True for '+', shape (k, r).

    Returns:
        (mean '+' - mean others) / sqrt(s1^2 / r1 + s2^2 / r2), shape (..., k, c). 0 where all
        runs agree to the bit; finite where they agree but for their label.
    """
    plus = labels.astype(np.float64)
    r1, r2 = plus[0].sum(), (1 - plus[0]).sum()
    centred = runs - runs[..., :1, :]  # first of all, so that runs that agree give exact zeros
    centred -= centred.mean(axis=-2, keepdims=True)
    size = np.sqrt(np.sum(centred**2, axis=-2, keepdims=True))
    z = np.divide(centred, size, out=np.zeros_like(centred), where=size > 0)
    # All sums from those of '+' alone: z sums to 0 and its squares to 1.
    first, squares = plus @ z, plus @ z**2
    within1 = squares - first**2 / r1
    within2 = 1 - squares - first**2 / r2
    variance = within1 / (r1 * (r1 - 1)) + within2 / (r2 * (r2 - 1))
    return first * (1 / r1 + 1 / r2) / np.sqrt(np.maximum(variance, np.finfo(np.float64).eps))


def family_wise_p(scores: FloatArray) -> FloatArray:
    """Single-step max-T p-values.

    Args:
        scores: abs(t) of k labellings and c quantities, the observed labelling first, shape
            (..., k, c).

    Returns:
        Share of the labellings whose largest abs(t) reaches each observed abs(t), shape (..., c).
    """
    largest = scores.max(axis=-1)[..., :, None]
    return np.mean(largest >= scores[..., :1, :] * (1 - _TIE), axis=-2)


def _mean_variance(runs: FloatArray) -> FloatArray:
    """Variance of the mean of r runs, shape (r, c) to (c,)."""
    return runs.var(axis=0, ddof=1) / len(runs)
