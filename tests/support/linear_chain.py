"""Experiments with a linear chain without physics: run both ways, kicked, swept."""

import numpy as np

from support.joint_runs import EPOCH_NS, turns, write_joints

NAMES = ("j1", "j2", "j3", "j4", "j5")
M = len(NAMES)
PLACE = np.arange(M)
DISTANCE = np.abs(PLACE[:, None] - PLACE[None, :])
CHAIN = np.diag(np.full(M, 0.9 * np.exp(-0.3j))) + 0.12 * np.exp(-DISTANCE + 0.5j)
WAVE = 0.4 * np.exp(-1j * np.pi / 3 * PLACE)
MODULE = np.ones(M, dtype=complex)
MODULE[1] = 0.97 * np.exp(-0.02j)
"""j2 is weak."""


def write_run(path, command, answer, seed, sigma, *, names=NAMES, **options):
    """Write six cycles at 50 Hz; options are those of :func:`.write_joints`."""
    noise = np.random.default_rng(seed).normal(0.0, sigma, (300, M))
    turn = turns(1.0, 300)
    return write_joints(
        path,
        names,
        np.real(command * turn),
        [np.real(answer * turn) + noise],
        epoch_ns=EPOCH_NS + seed * 10_000_000_000,
        **options,
    )


def both_ways(folder):
    """Write six runs each way, in turn; the second joint is weak."""
    paths = []
    for k in range(6):
        for way, name in ((1, "forward"), (-1, "reverse")):
            command = WAVE[::way]
            answer = MODULE * (CHAIN @ command)
            paths.append(write_run(folder / f"{name}{k}.mcap", command, answer, len(paths), 0.003))
    return paths


def kicked(folder):
    """Write runs with every joint's command kicked in phase and amplitude, and one held out."""
    off = [np.zeros(M, dtype=complex)]
    for step in (0.05j, -0.05j, 0.05, -0.05):
        off += [np.where(joint == PLACE, step, 0) for joint in range(M)]
    off.append(1j * np.array([0.1, -0.12, 0.05, 0.08, -0.11]))
    commands = WAVE * np.exp(off)
    paths = [folder / f"run{k:02d}.mcap" for k in range(len(off))]
    runs = enumerate(zip(paths, commands, strict=True))
    return [write_run(path, command, CHAIN @ command, k, 0.002) for k, (path, command) in runs]


def swept(folder):
    """Write a lag sweep: the commands of the runs are the columns of a DFT."""
    dft = 0.02 * np.exp(2j * np.pi * np.outer(PLACE, PLACE) / M)
    return [
        write_run(folder / f"run{k}.mcap", dft[:, k], CHAIN @ dft[:, k], k, 1e-5) for k in PLACE
    ]


def asymmetry(X):
    """||X - X'|| / ||X|| off the diagonal."""
    off = X - np.diag(np.diag(X))
    return np.linalg.norm(off - off.T) / np.linalg.norm(off)


def within(X, width):
    """Share of the energy off the diagonal within a band."""
    off = X - np.diag(np.diag(X))
    return (np.linalg.norm(np.triu(np.tril(off, width), -width)) / np.linalg.norm(off)) ** 2
