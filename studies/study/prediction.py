"""How oscillators synchronise through the body, predicted from open-loop kicks of 5 to 50 joints.

:mod:`study.loops` has the equation. Rows have these errors, in shares of the kick:

* ``error``: of this prediction, with the interval that the errors of P, R, gain and lag leave;
* ``averaged``: of the average over a cycle;
* ``still``: of 'nothing moves';
* ``toeplitz``: of a homogeneous chain's P, as strong (``homogeneous``), the rest as measured.

``nice -n 15 .venv/bin/python studies/study/prediction.py --out out/prediction`` computes all, an
hour and a half of one core; every computation is a file, so an interrupted one goes on where it
stopped. ``--quick`` takes 5 yaw joints and one or two kicks, some minutes.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))
from study.loops import STANDARD, Case, Loop, closed_loop, open_loop

SIZES = (5, 13, 25, 50)
ENGINES, LAWS = ("bullet", "mujoco"), ("ellipse", "transeth")
PATTERNS = 10
"""Kicks of each case: the patterns of the seeds 1 to 10."""


def rows(folder: Path) -> pd.DataFrame:
    """Return all that is computed so far.

    Returns:
        ``kind`` 'P': a row for each chain, with ``P`` and ``R`` as lists of rows; ``kind`` 'kick':
        a row for each chain, loop and pattern, with ``t_s`` and errors over time as lists.
    """
    files = sorted(folder.glob("*.parquet"))
    return pd.concat([pd.read_parquet(file) for file in files], ignore_index=True)


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return one line for each chain and loop: the means over patterns, and the worst."""
    keys = [*Case.__annotations__, *Loop.__annotations__]
    kicks = table[table.kind == "kick"]

    def line(group: pd.DataFrame) -> pd.Series:
        half = 2.262 * group.error.std() / len(group) ** 0.5 if len(group) == 10 else math.nan
        return pd.Series(
            {
                "error": group.error.mean(),
                "+-": half,
                "worst": group.error.max(),
                "at any time": group.error_most.max(),
                "averaged": group.averaged.mean(),
                "averaged, any time": group.averaged_most.max(),
                "of P": (group.error_high - group.error_low).max() / 2,
                "still": group.still.mean(),
                "error/still": group.error.mean() / group.still.mean(),
                "toeplitz": group.toeplitz.mean(),
                "below": f"{(group.error < group.toeplitz).sum()}/{len(group)}",
                "left": group.left.mean(),
                "foretold": group.foretold.mean(),
            }
        )

    return kicks.groupby(keys, sort=True).apply(line, include_groups=False).reset_index()


def body(out: Path, case: Case) -> dict:
    """Return the row of a chain's P; computed where there is none yet."""
    (row,) = _kept(out / f"P-{_key(case)}.parquet", lambda: [open_loop(case)])
    return row


def kicks(out: Path, case: Case, loop: Loop = STANDARD, patterns: int = PATTERNS) -> list[dict]:
    """Return the rows of the kicks of a closed loop; computed where there are none yet."""
    identified = body(out, case)
    return _kept(
        out / f"kick-{_key(case)}-{_key(loop)}-{patterns}.parquet",
        lambda: closed_loop(case, loop, identified, patterns),
    )


def sizes(out: Path, chains: tuple[int, ...], patterns: int) -> None:
    """Predict chains of several sizes, in both engines and with both laws of friction."""
    for n, engine, law in product(chains, ENGINES, LAWS):
        kicks(out, Case(n, engine, law), patterns=patterns)


def limits(out: Path, n: int, patterns: int) -> None:
    """Look where the prediction breaks: larger kicks, stronger feedback, other servos and gaits."""
    for kick in (0.1, 0.4, 0.8, 1.2):
        kicks(out, Case(n), replace(STANDARD, kick=kick), patterns)
    for eps in (0.1, 0.6, 1.0, 2.0, 4.0):
        kicks(out, Case(n), replace(STANDARD, eps=eps), patterns)
    for stall in (0.1, 0.15, 0.5, 1.5):
        kicks(out, Case(n, stall=stall), patterns=patterns)
    for amplitude in (0.1, 0.2, 0.3, 0.5):
        kicks(out, Case(n, amplitude=amplitude), patterns=patterns)


def coupling(out: Path, n: int, patterns: int) -> None:
    """Add the smallest coupling that brings back every pattern at ``loops.RATE``; half; none."""
    K = body(out, Case(n))["explicit"]
    for share in (0.0, 0.5, 1.0):
        kicks(out, Case(n), Loop(K=round(share * K, 4), until_s=60.0), patterns)


def _key(part: Case | Loop) -> str:
    return "-".join(f"{value:g}" if isinstance(value, float) else str(value)
                    for value in asdict(part).values())  # fmt: skip


def _kept(path: Path, compute) -> list[dict]:
    if not path.exists():
        frame = pd.DataFrame(compute())
        part = path.with_suffix(".part")
        frame.to_parquet(part)
        part.rename(path)
        print(f"{time.strftime('%H:%M:%S')} {path.name}", flush=True)
    return pd.read_parquet(path).to_dict("records")


def main() -> None:
    """Compute what is asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, help="folder of the row files")
    parser.add_argument("--quick", action="store_true", help="5 yaw joints, few kicks")
    parser.add_argument("--joints", type=int, nargs="*", help="yaw joints")
    parser.add_argument(
        "--parts", nargs="*", default=["sizes", "coupling", "limits"], help="which of them"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        out = options.out or Path(name)
        out.mkdir(parents=True, exist_ok=True)
        chains = tuple(options.joints or (SIZES[:1] if options.quick else SIZES))
        patterns = 2 if options.quick else PATTERNS
        if "sizes" in options.parts:
            sizes(out, chains, patterns)
        if "coupling" in options.parts:
            for n in chains[:1] if options.quick else (9, 13):
                coupling(out, n, 1 if options.quick else 3)
        if "limits" in options.parts and not options.quick:
            limits(out, 9, 5)
        with pd.option_context("display.width", 250, "display.max_columns", 30):
            print(summary(rows(out)).round(3).to_string())


if __name__ == "__main__":
    main()
