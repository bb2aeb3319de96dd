"""The table of docs/explanation/estimators.md on joints at two frequencies.

``.venv/bin/python studies/group_tables.py [DRAWS]`` prints it; 500 draws take some minutes.
"""

from __future__ import annotations

import sys

import numpy as np

from undulog.analysis.estimators.series import Series
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.response.response import gain_estimate, lag_estimate

GOLDEN = (1 + 5**0.5) / 2

CASES = (
    ("1:1", 1.0, 0.0),
    ("3:2", 1.5, 0.0),
    ("3:2, nonlinear body", 1.5, 0.02),
    ("golden", GOLDEN, 0.0),
    ("golden, nonlinear body", GOLDEN, 0.02),
)
"""Name, ratio of the frequencies, size of the nonlinearity."""


class Snake:
    """Odd and even joints at two frequencies, coupled through a body that may be nonlinear.

    Args:
        ratio: Of the odd joints' frequency to the even ones' 0.954 Hz.
        seconds: Length of the record [s].
        rate: Samples a second.
        joints: How many.
        bend: Size of the products of neighbours' angles in each response.
        seed: Of amplitudes, gains, lags and couplings.
    """

    def __init__(self, ratio, *, seconds=12.0, rate=100.0, joints=16, bend=0.0, seed=0):
        """Make commands and noise-free responses."""
        rng = np.random.default_rng(seed)
        self.seconds, self.joints = seconds, joints
        count = round(seconds * rate)
        self.t = (np.arange(count) - count / 2) / rate
        self.skew_s = 2e-3
        self.group = np.arange(joints) % 2
        self.omega = 2 * np.pi * 0.954 * np.array([ratio, 1.0])
        omega = self.omega[self.group][:, None]
        self.amplitude = rng.uniform(0.3, 0.5, joints)
        phase = rng.uniform(-3, 3, 2)[self.group] - 0.8 * np.arange(joints)
        self.command = self.amplitude[:, None] * np.sin(omega * self.t + phase[:, None])
        gain, lag = rng.uniform(0.85, 1.05, joints), rng.uniform(0.05, 0.4, joints)
        later = self.t + self.skew_s
        size = (gain * self.amplitude)[:, None]
        alone = size * np.sin(omega * later + (phase - lag)[:, None])
        self.response = alone + 0.05 * rng.normal(size=(joints, joints)) @ alone
        beside = np.roll(self.response, 1, axis=0)
        self.response = self.response + bend * beside * (self.response + beside * self.response)
        self.names = [f"joint{k + 1:02d}" for k in range(joints)]

    def fit(self, noise=0.0, command_noise=0.0, warn=None):
        """Return the gait, with noise on responses and commands."""
        later = self.t + self.skew_s
        commands, responses = self.command + command_noise, self.response + noise
        return fit_gait(
            {n: Series(n, self.t, v) for n, v in zip(self.names, commands, strict=True)},
            {n: Series(n, later, v) for n, v in zip(self.names, responses, strict=True)},
            self.seconds,
            warn or (lambda _: None),
        )

    def estimates(self, gait):
        """Return lags and gains with both ends of their intervals, by joint, shape (2, 3, m)."""
        estimates = np.full((2, 3, self.joints), np.nan)
        for group in gait.groups:
            for k, name in enumerate(group.answered):
                for row, estimate in enumerate((lag_estimate, gain_estimate)):
                    result = estimate(group.response, k)
                    estimates[row, :, self.names.index(name)] = result.value, *result.ci95
        return estimates

    def bound(self, sigma):
        """Return Cramér-Rao bound of each lag, all tones and the shared frequencies unknown [rad].

        The Fisher information of all parameters of all channels, inverted as one dense matrix.
        """
        t = self.t + self.skew_s
        distinct = self.omega if self.omega[0] != self.omega[1] else self.omega[:1]
        lines = []
        for order in (1, 2, 3):
            for k, omega in enumerate(distinct):
                if all(abs(order * omega - line) > 1e-3 for line, _, _ in lines):
                    lines.append((order * omega, order, k))
        rows = [np.ones_like(t)]
        for line, _, _ in lines:
            rows += [np.cos(line * t), -np.sin(line * t)]
        phi = np.stack(rows)
        theta = np.linalg.lstsq(phi.T, self.response.T, rcond=None)[0]
        p, q = len(rows), len(distinct)
        fisher = np.zeros((self.joints * p + q, self.joints * p + q))
        for j in range(self.joints):
            slope = np.zeros((q, t.size))
            for b, (line, order, k) in enumerate(lines):
                re, im = theta[1 + 2 * b, j], theta[2 + 2 * b, j]
                slope[k] -= order * t * (re * np.sin(line * t) + im * np.cos(line * t))
            span = slice(j * p, (j + 1) * p)
            fisher[span, span] = phi @ phi.T
            fisher[span, -q:], fisher[-q:, span] = phi @ slope.T, slope @ phi.T
            fisher[-q:, -q:] += slope @ slope.T
        covariance = sigma**2 * np.linalg.inv(fisher)
        result = np.zeros(self.joints)
        for j in range(self.joints):
            k = self.group[j] if len(distinct) > 1 else 0
            b = next(i for i, (_, order, group) in enumerate(lines) if (order, group) == (1, k))
            place = j * p + 1 + 2 * b
            a = complex(theta[1 + 2 * b, j], theta[2 + 2 * b, j])
            across = np.array([-a.imag, a.real]) / abs(a)
            block = covariance[place : place + 2, place : place + 2]
            result[j] = (across @ block @ across) ** 0.5 / abs(a)
        return result


def draws_of(snake, sigma, count, seed):
    """Return errors of the lag [rad], shape (count, joints), and coverage of both intervals.

    The coverage, shape (count, 2, joints), is whether the interval of lag or gain holds the
    noise-free value; ``sigma`` is the standard deviation of the noise [rad].
    """
    rng = np.random.default_rng(seed)
    truth = snake.estimates(snake.fit())[:, 0]
    error, covered = [], []
    for _ in range(count):
        estimates = snake.estimates(snake.fit(rng.normal(0, sigma, snake.response.shape)))
        error.append(estimates[0, 0] - truth[0])
        covered.append((estimates[:, 1] <= truth) & (truth <= estimates[:, 2]))
    return np.array(error), np.array(covered)


def figures(snake, sigma, draws, seed=5):
    """Return RMSE of the lag over its bound, and coverage of lag and gain, shape (groups, 3)."""
    error, covered = draws_of(snake, sigma, draws, seed)
    ratio = np.mean(error**2, axis=0) / snake.bound(sigma) ** 2
    same = snake.omega[0] == snake.omega[1]
    members = [np.ones(snake.joints, bool)] if same else [snake.group == k for k in (0, 1)]
    return np.array(
        [[np.sqrt(ratio[mask].mean()), *covered[:, :, mask].mean(axis=(0, 2))] for mask in members]
    )


def main(draws):
    """Print the table."""
    print("| frequencies | group | lag: RMSE / bound | 95 % covers: lag | gain |")
    print("|---|---|---|---|---|")
    for name, ratio, bend in CASES:
        snake = Snake(ratio, bend=bend)
        rows = figures(snake, 2e-3, draws)
        for k, (rmse, lag, gain) in enumerate(rows):
            group = "all" if len(rows) == 1 else f"{snake.omega[k] / (2 * np.pi):.3f} Hz"
            print(f"| {name} | {group} | {rmse:.3f} | {100 * lag:.1f} % | {100 * gain:.1f} % |")


if __name__ == "__main__":
    main(10 if "--quick" in sys.argv else int(sys.argv[1]) if len(sys.argv) > 1 else 500)
