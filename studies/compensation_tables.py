"""The figures of docs/how-to/compensation.md: spread, speed and cost before and after compensation.

``nice .venv/bin/python studies/compensation_tables.py 5 13`` prints those of chains with so many
yaw joints, ``13:1.5`` those with servos of 1.5 N m instead of 0.25 N m. Each takes 4 m + 9 runs for
the kicks, of 18 s, and some 50 more: two to four minutes. ``--quick`` takes 3 yaw joints.

What is compensated is driven again with other noise and from other phases of the gait than were
used; so are gaits near it and further off, with the same change of the commands.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.compensating import Stage, Wave, indices, ratio
from undulog.analysis.plan.compensate import KEEP

RUNS, ROUNDS = 3, 2
NEIGHBOURS = (("amplitude", 1.1), ("amplitude", 0.9), ("frequency_hz", 1.1), ("frequency_hz", 0.9))
FURTHER = (("amplitude", 0.75), ("frequency_hz", 1.5), ("frequency_hz", 0.6))
LAGS_DEG = (5, -5, 15, -15)
T_95 = 4.303
"""Student's factor of three runs."""


def gaits(wave):
    """Yield gaits near the wave and further off, with their names."""
    for name, factor in (*NEIGHBOURS, *FURTHER):
        yield f"{name} x {factor:g}", replace(wave, **{name: factor * getattr(wave, name)})
    for degrees in LAGS_DEG:
        yield f"lag {degrees:+d} degrees", replace(wave, lag=wave.lag + math.radians(degrees))


def print_chain(m, stall, runs, rounds, keep=KEEP):
    """Print the figures of one chain."""
    stage, wave = Stage(m, stall), Wave(m)
    coupling = stage.kicks(wave, 1)
    planned = stage.compensate(coupling, wave, 2, rounds, keep)
    print(f"{m} yaw joints, {stall} N m, held-out patterns to {coupling.valid_to} rad")
    before = stage.drive(wave, [wave.phasors] * runs, [[3, k] for k in range(runs)])
    print(f"  before: {figures(before, wave)}")
    for k, (plan, commands) in enumerate(planned):
        after = stage.drive(wave, [commands] * runs, [[4, k, j] for j in range(runs)])
        print(f"  after step {k + 1}: {figures(after, wave)}")
        for now, then in zip(indices(after, wave), indices(before, wave), strict=True):
            value, low, high = ratio(now, then)
            print(f"    {now.label}, over before: {value:.3f} [{low:.3f}, {high:.3f}]")
        at_limit = [joint.name for joint in plan.joints if joint.lacking > 0]
        least = min(plan.joints, key=lambda joint: joint.margin)
        print(
            f"    predicted {plan.predicted_gain_cv:.2%}, "
            f"{math.degrees(plan.predicted_lag_sd):.2f} degrees; identified "
            f"{plan.identified:.2f} of {plan.directions}; largest step {plan.largest_step:.3f} of "
            f"{plan.step_limit:.3f}; at a limit: {at_limit or 'none'}; least margin {least.name} "
            f"{least.margin:.1%}",
            flush=True,
        )
    x = np.log(planned[-1][1] / wave.phasors)
    print(f"  phases {np.degrees(x.imag).round(1)} degrees, ln amplitudes {x.real.round(3)}")
    limit = min(joint.upper for joint in stage.robot.joints)
    for name, other in gaits(wave):
        commands = other.phasors * np.exp(x)
        cut = commands * np.minimum(1.0, limit / np.abs(commands))
        driven = stage.drive(other, [other.phasors, cut], [[5, 0], [5, 1]])
        pair = [indices([run], other) for run in driven]
        (cv, lag), (cv_after, lag_after) = pair
        print(
            f"  {name}: CV {cv.value:.2%} to {cv_after.value:.2%}, lag "
            f"{math.degrees(lag.value):.2f} to {math.degrees(lag_after.value):.2f} degrees",
            flush=True,
        )


def figures(runs, wave):
    """Describe runs of the same commands."""
    gain, lag = indices(runs, wave)
    parts = [
        f"CV {gain.value:.2%} [{gain.ci95[0]:.2%}, {gain.ci95[1]:.2%}]",
        "lag {:.2f} [{:.2f}, {:.2f}] degrees".format(*np.degrees((lag.value, *lag.ci95))),
    ]
    for name, unit in (("speed", " m/s"), ("cost_abs", ""), ("cost_el", ""), ("effort_j", " J")):
        values = np.array([getattr(run, name) for run in runs])
        half = T_95 * values.std(ddof=1) / len(values) ** 0.5
        parts.append(f"{name} {values.mean():.4f} +- {half:.4f}{unit}")
    return ", ".join(parts)


def main():
    """Print the figures of every chain that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("chains", nargs="*", help="yaw joints, or joints:stall torque [N m]")
    parser.add_argument("--quick", action="store_true", help="a chain of 3 yaw joints")
    parser.add_argument("--keep", type=float, default=KEEP, help="price of a change")
    options = parser.parse_args()
    runs, rounds = (2, 1) if options.quick else (RUNS, ROUNDS)
    for word in options.chains or ("3" if options.quick else "5",):
        m, _, stall = word.partition(":")
        print_chain(int(m), float(stall or 0.25), runs, rounds, options.keep)


if __name__ == "__main__":
    main()
