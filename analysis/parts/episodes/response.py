"""How the joints of a data set follow their commands: the response that all episodes share.

A joint follows by a delay d, a pole of time constant a, and a backlash of half width w:

    y(t) = b + g play(x(t), w),    X(s) = exp(-d s) C(s) / (1 + a s)                        (1)

with lines between the commands. Gain and offset are each episode's; d, a and w are those that leave
least of a sample of the episodes, of which a third may be faulty. What a servo does between two
frames, and other poles, go into d and a: they are the same in all episodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import TINY, WHOLE

from .record import EpisodeBlock

LATEST_S = 0.5
"""Longest delay and largest time constant that are tried [s]."""

CONSTANTS_S = (0.0, 0.03, 0.08, 0.2)
"""Time constants of the first search [s]."""

PLAYS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.04)
"""Half widths of the backlash that are tried, in parts of the joint's usual range."""

STEPS = 6
"""Steps of Gauss and Newton at most."""

LESS = 0.99
"""A backlash is taken if it leaves so much less: each further parameter leaves a little less."""

SETTLED = 3
"""Time constants after which it doesn't matter where a joint was before the first frame."""


@dataclass(frozen=True)
class EpisodeResponses:
    """Equation (1) of m joints.

    Attributes:
        delay: d [frames], shape (m,).
        constant: a [frames], shape (m,).
        play: w, in the commands' unit, shape (m,).
    """

    delay: FloatArray
    constant: FloatArray
    play: FloatArray

    @property
    def lag(self) -> FloatArray:
        """Lag of slow motion, d + a [frames], shape (m,)."""
        return self.delay + self.constant

    @property
    def settled(self) -> int:
        """Frames after which the joints follow."""
        return int(np.ceil(SETTLED * float(np.max(self.lag, initial=0.0)))) + 1


def lowpass(values: FloatArray, constant: FloatArray) -> FloatArray:
    """Return values through a pole, with lines between the frames, from rest at the first.

    The exact step from frame to frame of a first-order system with a ramp as input (Åström &
    Wittenmark, Computer-Controlled Systems, 3rd ed. 1997, 2.3).

    Args:
        values: Shape (t, ..., m).
        constant: [frames], shape (m,); 0 lets them pass.
    """
    safe = np.maximum(constant, TINY)
    decay = np.exp(-1 / safe)
    new = 1 - safe * (1 - decay)
    old = 1 - decay - new
    outputs = np.empty_like(values)
    outputs[0] = last = values[0]
    inputs = values[1:] * new + values[:-1] * old
    for step, entering in enumerate(inputs, start=1):
        last = entering + decay * last
        outputs[step] = last
    return outputs


def delayed(
    values: FloatArray, passed: FloatArray, delay: FloatArray, constant: FloatArray
) -> FloatArray:
    """Return what has passed a pole, later by a delay, exact between the frames.

    Args:
        values: Before the pole, shape (t, ..., m).
        passed: After it, the same shape.
        delay: [frames], shape (m,); negative ones are earlier.
        constant: [frames], shape (m,).
    """
    whole = np.floor(delay).astype(np.int64)
    since = 1 - (delay - whole)
    safe = np.maximum(constant, TINY)
    left = np.exp(-since / safe)
    new = since - safe * (1 - left)
    steps = np.arange(len(values))
    later = np.empty_like(values)
    for k in np.unique(whole).tolist():
        joints = np.flatnonzero(whole == k)
        some = slice(None) if joints.size == whole.size else joints
        ends = np.clip(steps - k, 0, len(values) - 1)
        begins = np.maximum(ends - 1, 0)
        old = 1 - new[some] - left[some]
        later[..., some] = (
            values[ends][..., some] * new[some]
            + values[begins][..., some] * old
            + passed[begins][..., some] * left[some]
        )
    return later


def play_of(values: FloatArray, half: FloatArray) -> FloatArray:
    """Return the output of a backlash: it stands until the input has moved through it."""
    if not half.any():
        return values
    outputs = np.empty_like(values)
    outputs[0] = last = values[0]
    above, below = values + half, values - half
    for step in range(1, len(values)):
        last = np.minimum(np.maximum(last, below[step]), above[step])
        outputs[step] = last
    return outputs


def followed(block: EpisodeBlock, response: EpisodeResponses) -> FloatArray:
    """Return x of equation (1) behind the backlash, shape (t, k, m)."""
    passed = lowpass(block.commands, response.constant)
    x = delayed(block.commands, passed, response.delay, response.constant)
    return play_of(x, response.play)


def centred(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return values less the mean of each episode, 0 outside of it.

    Args:
        values: Shape (t, k, m).
        weights: 1 inside, shape (t, k).
    """
    count = np.maximum(weights.sum(axis=0), 1.0)
    mean = np.einsum("tk,tkm->km", weights, values) / count[:, None]
    return (values - mean) * weights[:, :, None]


def dot(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the sum of products over the frames, shape (k, m)."""
    return np.einsum("tkm,tkm->km", left, right)


def fit_response(block: EpisodeBlock, fps: float) -> EpisodeResponses:
    """Fit the response of each joint to a sample of the episodes.

    Args:
        fps: Frames a second.
    """
    latest = max(int(np.ceil(LATEST_S * fps)), 2)
    settling = min(latest, len(block.inside) // 4)
    weights = block.inside.astype(np.float64)
    weights[:settling] = 0.0
    y = centred(block.states, weights)
    fitter = _Fitter(block, weights, y, dot(y, y))
    start = fitter.searched(np.array(CONSTANTS_S) * fps, latest)
    return fitter.with_play(fitter.improved(start, latest), latest)


@dataclass(frozen=True)
class _Fitter:
    """Sample of the episodes, with the states less their mean and the sum of their squares."""

    block: EpisodeBlock
    weights: FloatArray
    y: FloatArray
    power: FloatArray

    def left(self, x: FloatArray) -> FloatArray:
        """Return what x leaves of each episode's states with the best gain, shape (k, m)."""
        xx, xy = dot(x, x), dot(x, self.y)
        return self.power - xy**2 / np.maximum(xx, TINY)

    def pooled(self, left: FloatArray, kept: BoolArray | None = None) -> FloatArray:
        """Return what is left of the episodes that are kept, or of the best two thirds, (m,)."""
        kept = self.best(left) if kept is None else kept
        return np.where(kept, left, 0.0).sum(axis=0)

    def best(self, left: FloatArray) -> BoolArray:
        """Return the two thirds of the episodes of which least is left in parts, (k, m)."""
        share = left / np.maximum(self.power, TINY)
        limit = np.quantile(share, WHOLE, axis=0, method="higher")
        return share <= limit

    def searched(self, constants: FloatArray, latest: int) -> EpisodeResponses:
        """Return the best of a grid of whole delays and some constants."""
        m = int(self.y.shape[2])
        best = np.full(m, np.inf)
        delay, constant = np.zeros(m), np.zeros(m)
        for a in constants.tolist():
            passed = lowpass(self.block.commands, np.full((m,), a))
            for d in range(latest + 1):
                moved = passed[np.maximum(np.arange(len(passed)) - d, 0)]
                squares = self.pooled(self.left(centred(moved, self.weights)))
                better = squares < best
                best[better], delay[better], constant[better] = squares[better], d, a
        return EpisodeResponses(delay, constant, np.zeros(m))

    def improved(self, response: EpisodeResponses, latest: int) -> EpisodeResponses:
        """Take steps of Gauss and Newton in d and a, over the episodes that fit best."""
        x = centred(followed(self.block, response), self.weights)
        left = self.left(x)
        kept = self.best(left)
        squares = self.pooled(left, kept)
        size = np.ones_like(squares)
        for _ in range(STEPS):
            step_d, step_a = self._step(response, x, kept)
            tried = EpisodeResponses(
                np.clip(response.delay + size * step_d, -1.0, latest),
                np.clip(response.constant + size * step_a, 0.0, latest),
                response.play,
            )
            x_tried = centred(followed(self.block, tried), self.weights)
            squares_tried = self.pooled(self.left(x_tried), kept)
            better = squares_tried < squares
            response = chosen(better, tried, response)
            x = np.where(better, x_tried, x)
            gained = np.where(better, squares - squares_tried, 0.0)
            squares = np.where(better, squares_tried, squares)
            size = np.where(better, 1.0, size / 4)
            if not np.any(gained > 1e-4 * squares) and np.all(size < 1e-2):
                break
        return response

    def _step(
        self, response: EpisodeResponses, x: FloatArray, kept: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the steps of d and a, from derivatives less their part along x."""
        gain = dot(x, self.y) / np.maximum(dot(x, x), TINY)
        late = rate_of(x, self.weights)
        slopes = late, centred(lowpass(late, response.constant), self.weights)
        rest = self.y - gain * x
        free = [gain * (s - x * (dot(x, s) / np.maximum(dot(x, x), TINY))) for s in slopes]
        dd, da, aa, dr, ar = (
            np.where(kept, dot(p, q), 0.0).sum(axis=0)
            for p, q in (
                (free[0], free[0]), (free[0], free[1]), (free[1], free[1]),
                (free[0], rest), (free[1], rest),
            )
        )  # fmt: skip
        dd, aa = dd * (1 + 1e-6) + TINY, aa * (1 + 1e-6) + TINY
        determinant = np.maximum(dd * aa - da**2, TINY)
        return (aa * dr - da * ar) / determinant, (dd * ar - da * dr) / determinant

    def with_play(self, response: EpisodeResponses, latest: int) -> EpisodeResponses:
        """Return the response with the backlash that leaves least, if that is less."""
        commands = self.block.commands
        usual = np.asarray(np.median(commands.max(axis=0) - commands.min(axis=0), axis=0), float)
        best = response
        squares = self.pooled(self.left(centred(followed(self.block, response), self.weights)))
        squares = squares * LESS
        for part in PLAYS[1:]:
            tried = self.improved(
                EpisodeResponses(response.delay, response.constant, part * usual), latest
            )
            now = self.pooled(self.left(centred(followed(self.block, tried), self.weights)))
            better = now < squares
            squares = np.where(better, now, squares)
            best = chosen(better, tried, best)
        return best


def chosen(better: BoolArray, tried: EpisodeResponses, best: EpisodeResponses) -> EpisodeResponses:
    """Return one of two responses for each joint."""
    return EpisodeResponses(
        np.where(better, tried.delay, best.delay),
        np.where(better, tried.constant, best.constant),
        np.where(better, tried.play, best.play),
    )


def rate_of(x: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the derivative of x by the delay [1/frame], less its mean, shape (t, k, m).

    Args:
        x: Less its mean, shape (t, k, m).
        weights: 1 inside, shape (t, k).
    """
    late = np.zeros_like(x)
    late[1:-1] = (x[:-2] - x[2:]) / 2
    inner = weights.copy()  # frames with one on either side
    inner[1:] *= weights[:-1]
    inner[:-1] *= weights[1:]
    return centred(late * inner[:, :, None], weights)


def sample_of(lengths: IntArray, motion: FloatArray, most: int) -> IntArray:
    """Return episodes for the fit, evenly of those that are long enough and move.

    Args:
        lengths: Frames, shape (e,).
        motion: A size of each one's motion, shape (e,).
        most: Number of episodes.
    """
    good = np.flatnonzero((motion >= np.median(motion) / 2) & (lengths >= np.median(lengths) / 2))
    return good[np.unique(np.linspace(0, good.size - 1, min(most, good.size)).astype(np.int64))]
