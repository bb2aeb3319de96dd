"""Kick experiments on a linear chain as phasors, without sessions."""

import math

import kick_tables
import numpy as np

from undulog.analysis.experiment.kick_runs import KickExperiment, KickKind, sort_kicks


def kicked(random, H, c, kicks, scatter, *, bend=0.0, size=1.0, late=0.0, noise=None):
    """Return kicks as phasors; ``late`` turns a kicked run's responses towards the kick."""
    noise = kick_tables.NOISE if noise is None else noise
    off = np.zeros((len(kicks), len(c)), dtype=complex)
    for k, kick in enumerate(kicks):
        if kick is not None:
            off[k, kick.joint] = size * kick.size * (1j if kick.kind is KickKind.PHASE else 1.0)
    commands = c * np.exp(off)
    answers = (commands * (1 - bend * np.abs(commands) ** 2)) @ H.T
    answers = answers * np.exp(1j * late * off.imag.sum(axis=1, keepdims=True))
    shape = commands.shape
    errors = random.normal(size=shape) + 1j * random.normal(size=shape)
    ratio = answers / commands * np.exp(math.hypot(scatter, noise) * errors)
    names = tuple(f"j{k + 1}" for k in range(len(c)))
    variance = np.full(shape, noise**2)
    return KickExperiment(
        index=tuple(range(len(kicks))),
        runs=sort_kicks(commands),
        names=names,
        command=c,
        ratio=ratio,
        log_gain_variance=variance,
        lag_variance=variance,
        dof=np.full(shape, 20.0),
        labels=tuple(f"run{k}" for k in range(len(kicks))),
        frequency_hz=0.5,
    )
