"""The tables of docs/explanation/faults.md on errors: how often an answer names what is not there.

``.venv/bin/python studies/answer_tables.py [SESSIONS]`` prints them as Markdown; with 2,000
sessions a cell it takes about twenty minutes on two cores. Nothing is written to files: commands
and positions are made in memory and given to the same functions as those of a session.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.stats import norm

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.comparison.examine import Chain, examine
from undulog.analysis.response.fitting import fit_gait
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples

GAIN, LAG = 0.95, np.radians(10.0)
JOINTS = 9
"""In each plane."""

SIGMA = 4e-3
"""Standard deviation of the noise [rad]."""

STEP = np.radians(0.088)
"""Of a 12-bit encoder [rad]."""

AR = 0.9
SHARED = 0.9
"""Share of the noise's variance that all joints have in common."""

MARGIN_GAIN, MARGIN_LAG_RAD = 0.02, np.radians(1.0)
NOISES = ("white", "AR(0.9)", "shared", "quantised")
STATEMENTS = ("not following", "stands out", "shape")
QUANTITIES = ("gain", "lag")
CELLS = tuple(product(NOISES, (1, 2)))
ODD_CELLS = tuple(product(NOISES, (1, 2), QUANTITIES))


class Recorded(NamedTuple):
    """One session in memory.

    Attributes:
        names: Of the joints, head to tail.
        planes: Plane of each joint.
        t_s: Sampling times [s], shape (n,).
        command: [rad], shape (m, n).
        position: [rad], shape (m, n).
    """

    names: tuple[str, ...]
    planes: tuple[str, ...]
    t_s: np.ndarray
    command: np.ndarray
    position: np.ndarray


def session(random, noise, planes, *, odd=None, quantity="gain"):
    """Return a session of identical joints in one kind of noise.

    Args:
        random: Generator.
        noise: One of ``NOISES``.
        planes: 1 or 2, each with ``JOINTS`` joints, in turn along the body.
        odd: Index of a joint that is off by three half widths, or None.
        quantity: ``gain`` or ``lag``: the quantity of that joint that is off.
    """
    m, rate = JOINTS * planes, 50.0
    frequency = 0.5 if noise == "quantised" else random.uniform(0.4, 1.2)
    t = np.arange(round(15.0 * rate)) / rate
    omega = 2 * np.pi * frequency
    by_plane = np.arange(m) % planes
    amplitude = random.uniform(0.2, 0.6) * np.where(by_plane == 0, 1.0, random.uniform(0.6, 1.0))
    phase = (
        random.uniform(-np.pi, np.pi)
        - np.arange(m) * random.uniform(0.4, 1.6)
        + by_plane * random.uniform(-np.pi, np.pi)
    )
    gain, lag = np.full(m, GAIN), np.full(m, LAG)
    if odd is not None:
        response = gain * amplitude * np.exp(1j * (phase - lag))
        half = half_width(noise, planes, odd, t, omega=omega, response=response)
        margin = MARGIN_GAIN if quantity == "gain" else MARGIN_LAG_RAD
        size = max(3 * half, margin + 2 * half) * random.choice([-1.0, 1.0])
        gain[odd] *= np.exp(size) if quantity == "gain" else 1.0
        lag[odd] += size if quantity == "lag" else 0.0
    angle = omega * t + phase[:, None]
    offset = random.uniform(-0.3, 0.3, (m, 1)) * (noise == "quantised")
    command = offset + amplitude[:, None] * np.sin(angle)
    clean = offset + (gain * amplitude)[:, None] * np.sin(angle - lag[:, None])
    position = clean + noise_of(random, noise, m, t.size)
    if noise == "quantised":
        position = np.round(position / STEP) * STEP
    names = tuple(f"joint{i + 1:02d}" for i in range(m))
    kinds = tuple("horizontal" if k == 0 else "vertical" for k in by_plane)
    return Recorded(names, kinds, t, command, position)


def noise_of(random, noise, m, n):
    """Return noise of the positions [rad], shape (m, n)."""
    if noise == "quantised":  # of the encoder alone
        return np.zeros((m, n))
    if noise == "AR(0.9)":
        drawn = random.normal(size=(m, n + 200))
        return SIGMA * lfilter([(1 - AR**2) ** 0.5], [1.0, -AR], drawn)[:, 200:]
    separate = SIGMA * random.normal(size=(m, n))
    if noise == "white":
        return separate
    return (1 - SHARED) ** 0.5 * separate + SHARED**0.5 * SIGMA * random.normal(size=n)


def half_width(noise, planes, joint, t, *, omega, response):
    """Return half width of the simultaneous 95 % interval of one joint's log gain or lag [rad].

    Of its deviation from what a common value, a trend and a parabola through the plane's other
    joints predict; Bonferroni over all joints and three quantities. In closed form from the
    spectrum of the noise, not from the code under test.
    """
    place = np.linspace(-1.0, 1.0, JOINTS)
    basis = np.stack([place**k for k in range(3)], axis=1)
    j = joint // planes
    others = np.delete(np.arange(JOINTS), j)
    weights = np.zeros(JOINTS)
    weights[others] = -basis[j] @ np.linalg.pinv(basis[others])
    weights[j] = 1.0
    scaled = weights / response[joint % planes :: planes]
    n, power = t.size, SIGMA**2
    if noise == "AR(0.9)":
        power *= (1 - AR**2) / abs(1 - AR * np.exp(-1j * omega * (t[1] - t[0]))) ** 2
    if noise == "quantised":  # half-wave symmetry leaves so many distinct phases
        n, power = round(np.pi / (omega * (t[1] - t[0]))), STEP**2 / 12
    single = float(np.sum(np.abs(scaled) ** 2))
    share = SHARED if noise == "shared" else 0.0
    spread = (1 - share) * single + share * abs(np.sum(scaled)) ** 2
    factor = norm.ppf(1 - 0.025 / (3 * JOINTS * planes))
    return float(factor * (2 * power / n * spread) ** 0.5)


def stated(recorded):
    """Return the joints that are named by each of ``STATEMENTS``; for ``shape`` its kinds.

    This is the only call of the code under test.
    """
    joints, planes, t_s, command, position = recorded
    motions = [
        RecordedJoint(name, Samples(t_s, asked), Samples(t_s, moved))
        for name, asked, moved in zip(joints, command, position, strict=True)
    ]
    broken = tuple(fault.joint for fault in judge(motions).faults)
    series = [
        {name: Series(name, t_s, row) for name, row in zip(joints, rows, strict=True)}
        for rows in (command, position)
    ]
    gait = fit_gait(*series, float(t_s[-1]), lambda _: None)
    chains = []
    for plane in dict.fromkeys(planes):
        commanded = tuple(
            n for n, joint_plane in zip(joints, planes, strict=True) if joint_plane == plane
        )
        names = tuple(name for name in commanded if name in gait.answered and name not in broken)
        response = gait.response.select([gait.answered.index(name) for name in names])
        chains.append(Chain(plane, 0, commanded, names, response))
    findings = examine(chains)
    outside = tuple(dict.fromkeys(deviation.joint for deviation in findings.stand_out))
    shapes = tuple(dict.fromkeys(shape.kind for shape in findings.shape))
    return dict(zip(STATEMENTS, (broken, outside, shapes), strict=True))


def identical(sessions, seed=1):
    """Return shares of sessions of identical joints by (noise, planes).

    The shares are those with any statement, then with each of ``STATEMENTS``.
    """
    return {cell: identical_cell(sessions, seed, *cell) for cell in CELLS}


def identical_cell(sessions, seed, noise, planes):
    """Return the shares of one cell of :func:`identical`."""
    random = np.random.default_rng([seed, NOISES.index(noise), planes])
    counts = np.zeros(len(STATEMENTS) + 1)
    for _ in range(sessions):
        answer = stated(session(random, noise, planes))
        claims = [bool(answer[kind]) for kind in STATEMENTS]
        counts += [any(claims), *claims]
    return counts / sessions


def one_off(sessions, seed=2):
    """Return shares of sessions by (noise, planes, quantity).

    The shares are those in which the joint that is off is named, and in which another one is.
    """
    return {cell: one_off_cell(sessions, seed, *cell) for cell in ODD_CELLS}


def one_off_cell(sessions, seed, noise, planes, quantity):
    """Return the shares of one cell of :func:`one_off`."""
    k = QUANTITIES.index(quantity)
    random = np.random.default_rng([seed, NOISES.index(noise), planes, k])
    counts = np.zeros(2)
    for _ in range(sessions):
        odd = int(random.integers(JOINTS * planes))
        made = session(random, noise, planes, odd=odd, quantity=quantity)
        answer = stated(made)
        named = {*answer["not following"], *answer["stands out"]}
        joint = made.names[odd]
        counts += [joint in named, bool(named - {joint})]
    return counts / sessions


def main(sessions=2000):
    """Print both tables, a process a core."""
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        rows = pool.map(partial(identical_cell, sessions, 1), *zip(*CELLS, strict=True))
        odd_sessions = max(sessions // 4, 1)
        odd_rows = pool.map(partial(one_off_cell, odd_sessions, 2), *zip(*ODD_CELLS, strict=True))
        print(f"Identical joints, {sessions:,} sessions a line:\n")
        print("| noise | planes | any statement | not following | stands out | shape |")
        print("|---|---|---|---|---|---|")
        for cell, shares in zip(CELLS, rows, strict=True):
            print_row(*cell, *(f"{100 * x:.2f} %" for x in shares))
        print(f"\nOne joint off by three half widths, {odd_sessions:,} sessions a line:\n")
        print("| noise | planes | by | it is named | another is |")
        print("|---|---|---|---|---|")
        for cell, shares in zip(ODD_CELLS, odd_rows, strict=True):
            print_row(*cell, *(f"{100 * x:.1f} %" for x in shares))


def print_row(*cells):
    """Print a row of a Markdown table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main(*(4 if word == "--quick" else int(word) for word in sys.argv[1:]))
