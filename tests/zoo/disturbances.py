"""Noise of positions with a known spectrum, encoders that count in steps, and pauses of a bus."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

SETTLED = 1e-2
"""Share of the start of a recursion that is left when its output counts."""


@dataclass(frozen=True)
class Noise:
    """Noise of one joint: a white part and a first-order autoregression.

    Attributes:
        white: Standard deviation of the white part [rad].
        coloured: Standard deviation of the autoregression [rad].
        rho: Its correlation from sample to sample.
        shared: Share of the variance that all joints have in common.
        tail: Index of Student's t for the white part, scaled to its standard deviation; 0: normal.
        relative: Standard deviation of a part that is proportional to the way from the middle.
    """

    white: float
    coloured: float = 0.0
    rho: float = 0.0
    shared: float = 0.0
    tail: float = 0.0
    relative: float = 0.0

    @property
    def deviation(self):
        """Standard deviation [rad] but for the proportional part."""
        return float(np.hypot(self.white, self.coloured))

    def draw(self, rng, way):
        """Return noise [rad].

        Args:
            rng: Generator.
            way: Of each joint from its middle [rad], shape (n, m).

        Returns:
            Shape (n, m).
        """
        n, m = way.shape
        drawn = (1 - self.shared) ** 0.5 * self._drawn(rng, n, m)
        if self.shared > 0:
            drawn += self.shared**0.5 * self._drawn(rng, n, 1)
        if self.relative > 0:
            drawn += self.relative * way * rng.normal(size=(n, m))
        return drawn

    def _drawn(self, rng, n, m):
        if self.tail > 0:  # the variance of Student's t is tail / (tail - 2)
            white = rng.standard_t(self.tail, (n, m)) * ((self.tail - 2) / self.tail) ** 0.5
        else:
            white = rng.normal(size=(n, m))
        if self.coloured == 0:
            return self.white * white
        share = (1 - self.rho**2) ** 0.5
        before = self.rho * rng.normal(size=(1, m))  # stationary from the first sample on
        driven = rng.normal(size=(n, m))
        coloured = lfilter([share], [1.0, -self.rho], driven, axis=0, zi=before)[0]
        return self.white * white + self.coloured * coloured

    def whitened(self, rows, way, step=0.0):
        """Return rows filtered so that this noise would be white with a variance of 1.

        White noise and an autoregression add up to an ARMA(1, 1), whose innovations form comes
        from the factors of its spectrum (Box and Jenkins, Time Series Analysis, 1976, chapter 3):
        s^2 (1 + q^2) = white^2 (1 + rho^2) + coloured^2 (1 - rho^2), s^2 q = white^2 rho.

        Args:
            rows: Shape (k, n).
            way: Of the joint from its middle [rad], shape (n,).
            step: Standard deviation of what an encoder's steps add to the white part [rad].

        Returns:
            Shape (k, n'), without the samples in which the filter starts. What joints share is
            left out: it cancels in a comparison.
        """
        share = (1 - self.shared) ** 0.5
        white, coloured = float(np.hypot(share * self.white, step)), share * self.coloured
        if self.relative > 0:
            return rows / np.hypot(np.hypot(white, coloured), self.relative * way)
        if coloured == 0:
            return rows / white
        both = white**2 * (1 + self.rho**2) + coloured**2 * (1 - self.rho**2)
        cross = white**2 * self.rho
        q = 0.0
        if cross > 0:
            q = (both - (both**2 - 4 * cross**2) ** 0.5) / (2 * cross)
        variance = both / (1 + q**2)
        filtered = lfilter([1.0, -self.rho], [1.0, -q], rows, axis=1) / variance**0.5
        first = 1 + (int(np.log(SETTLED) / np.log(q)) if q > 0 else 0)
        return filtered[:, min(first, rows.shape[1] // 4) :]


def quantised(values, step):
    """Return values in whole steps of an encoder; a step of 0 leaves them as they are."""
    return values if step == 0 else np.round(values / step) * step


def step_deviation(step, way):
    """Return a standard deviation that stands for the rounding errors of an encoder [rad].

    They are even within a step: step / 12^0.5. Slower than a step a sample they last for several
    samples, so that the sum of n has the variance of as many white errors times how long they
    last: step over the mean way from sample to sample. That overstates what they do to a motion
    that passes many steps a cycle.

    Args:
        step: Of the encoder [rad].
        way: Of the joint [rad], shape (n,).
    """
    if step == 0:
        return 0.0
    speed = float(np.mean(np.abs(np.diff(way))))
    lasts = max(1.0, step / max(speed, 1e-12))
    return step * (min(lasts, len(way)) / 12) ** 0.5


def repeated(values, pauses):
    """Return values of which the last before a pause is repeated in it.

    Args:
        values: Of all joints, shape (n, m).
        pauses: First sample and number of samples of each pause, shape (p, 2).
    """
    out = values.copy()
    for first, count in pauses:
        out[first : first + count] = out[first - 1]
    return out
