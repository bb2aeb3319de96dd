"""The figures of docs/explanation/oscillators.md: P in contact, its modes, and what they predict.

``nice .venv/bin/python studies/oscillator_tables.py 5 9 13`` prints those of chains with so many
yaw joints (every other joint is a yaw joint, as in snake25), ``13:1.5`` those with servos of 1.5 N
m instead of 0.25 N m. Each chain takes 2 m + 6 runs of 20 s or more on the compiled twin: half a
minute to one and a half. ``--quick`` takes 3 yaw joints, only to see that it runs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from undulog.analysis.oscillators.laplacian import spectrum
from undulog.analysis.oscillators.predictions import homogeneous

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support import closed_loop

HELD_OUT = (0.05, 0.1, 0.15)


def print_chain(m, stall):
    """Print the figures of one chain."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        closed_loop.write_chain(folder, m, stall)
        experiment = closed_loop.open_loop(folder, m, HELD_OUT)
        print(f"{m} yaw joints, {stall} N m")
        print("\n".join(f"  {line}" for line in coupling_lines(experiment.coupling)))
        print(f"  {experiment.oscillators.answer}")
        ratio = closed_loop.base_response(experiment)
        run = closed_loop.closed_loop(folder, experiment.coupling, ratio)
        print(f"  closed loop, eps {closed_loop.EPS}, {run.t_s[-1]:.1f} s after a kick:")
        print(f"    moved by {run.moved[-1]:.1%} of it; prediction off by {run.error[-1]:.1%}")
        print(f"    of it, at most {run.error.max():.1%}", flush=True)


def coupling_lines(coupling):
    """What there is to say of P and R."""
    P, R = (np.array(estimate.value) for estimate in (coupling.P, coupling.R))
    diagonal = np.diag(P)
    yield f"P, diagonal: {np.round(diagonal, 3)}"
    yield f"  ends {diagonal[[0, -1]].mean():.3f}, inside {diagonal[1:-1].mean():.3f}"
    yield f"  half widths up to {np.max(coupling.P.ci95_half):.1e}"
    yield f"  next joint tailwards {np.round(np.diag(P, 1), 3)}"
    yield f"  next joint headwards {np.round(np.diag(P, -1), 3)}"
    yield f"  ||I - P|| {np.linalg.norm(np.eye(len(P)) - P):.3f}"
    yield f"rows: P to {abs(P.sum(axis=1) - 1).max():.1e}, R to {abs(R.sum(axis=1)).max():.1e}"
    for pattern in coupling.held_out:
        better = pattern.error_kept / pattern.error
        yield (
            f"held out {pattern.size:.3f} rad: {pattern.error:.2%}, kept {pattern.error_kept:.2%}, "
            f"{better:.1f} times better"
        )
    for label, matrix in (("P", P), ("homogeneous", homogeneous(P))):
        modes = spectrum(matrix)
        rates = np.round(modes.rates, 3)
        yield f"{label}: slowest {modes.gap:+.4f}, strong {modes.strong}, rates {rates}"


def main():
    """Print the figures of every chain that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("chains", nargs="*", help="yaw joints, or joints:stall torque [N m]")
    parser.add_argument("--quick", action="store_true", help="a chain of 3 yaw joints")
    options = parser.parse_args()
    for word in options.chains or ("3" if options.quick else "5",):
        m, _, stall = word.partition(":")
        print_chain(int(m), float(stall or 0.25))


if __name__ == "__main__":
    main()
