"""Figures of the benches: printed beside their bars, and collected for the page of benchmarks.

``bench/all.py`` names a file in the environment; each figure is appended to it as a JSON object on
a line of its own.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.stats import t as student

RECORDS = "UNDULOG_BENCH_RECORDS"
"""The variable with the path of the file that figures are appended to."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """A row of the page.

    Attributes:
        what: The quantity.
        value: Its value; of a comparison our cost over the peer's. None where nothing was measured.
        unit: Its unit; empty for a ratio or a number.
        low: Lower end of the 95 % interval of a ratio; None for a single turn.
        high: Its upper end.
        ours: Our cost, turn by turn.
        theirs: The peer's cost in the same turns.
        cost_unit: The unit of both.
        peer: The peer and its version.
        bar: The most or the least that is allowed; None if nothing is judged.
        most: Whether the bar is an upper one.
        met: Whether the bar is met; None without a bar.
        note: Why nothing was measured.
    """

    what: str
    value: float | None = None
    unit: str = ""
    low: float | None = None
    high: float | None = None
    ours: tuple[float, ...] = ()
    theirs: tuple[float, ...] = ()
    cost_unit: str = "s"
    peer: str = ""
    bar: float | None = None
    most: bool = True
    met: bool | None = None
    note: str = ""


def keep(record: Record) -> None:
    """Append a record to the file of the run, if there is one."""
    if path := os.environ.get(RECORDS):
        with Path(path).open("a") as stream:
            stream.write(json.dumps(asdict(record)) + "\n")


def verdict(
    what: str, value: float, bar: float | None, unit: str, *, most: bool = True, peer: str = ""
) -> bool:
    """Print and keep a figure with its bar; return whether the bar is met.

    Args:
        what: The quantity.
        value: Its value.
        bar: The most that is allowed, or the least; None to judge nothing.
        unit: Unit of both.
        most: Whether the bar is an upper one.
        peer: Where the bar comes from, if another program or a document sets it.
    """
    record = Record(what=what, value=value, unit=unit, bar=bar, most=most, peer=peer)
    return _judged(record, f"{value:.4g} {unit}".rstrip())


def compared(
    what: str,
    ours: Sequence[float],
    theirs: Sequence[float],
    peer: str,
    *,
    bar: float | None = None,
    unit: str = "s",
    scale: float = 1.0,
) -> bool:
    """Print and keep the ratio of our cost to a peer's; return whether the bar is met.

    Args:
        what: The work.
        ours: Our cost, turn by turn; the peer's turn follows each.
        theirs: The peer's cost, turn by turn.
        peer: The peer and its version.
        bar: The largest ratio that is allowed; None to judge nothing.
        unit: Of the costs.
        scale: What the peer's cost is multiplied by, for a peer that did a part of the work.
    """
    peers = [scale * cost for cost in theirs]
    ratio, low, high = ratio_of(ours, peers)
    record = Record(
        what=what, value=ratio, low=low, high=high, ours=tuple(ours), theirs=tuple(peers),
        cost_unit=unit, peer=peer, bar=bar,
    )  # fmt: skip
    interval = "" if low is None else f" ({low:.3g} to {high:.3g})"
    mine, other = (f"{np.median(costs):.4g} {unit}" for costs in (ours, peers))
    return _judged(record, f"{ratio:.3g}{interval} times {peer}, {mine} and {other}")


def ratio_of(
    ours: Sequence[float], theirs: Sequence[float]
) -> tuple[float, float | None, float | None]:
    """Return the geometric mean of the paired ratios and its 95 % interval.

    The interval is Student's, of the mean of the logarithms; None for fewer than two pairs.
    """
    logs = np.log(np.asarray(ours, dtype=float) / np.asarray(theirs, dtype=float))
    mean = float(logs.mean())
    if logs.size < 2:
        return math.exp(mean), None, None
    half = float(student.ppf(0.975, logs.size - 1) * logs.std(ddof=1) / math.sqrt(logs.size))
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def not_run(what: str, why: str) -> None:
    """Print and keep that something was not measured."""
    keep(Record(what=what, note=f"not run: {why}"))
    print(f"----  {what}: not run: {why}")


def versions(*distributions: str) -> str:
    """Return names and versions of installed packages, joined."""
    return " + ".join(f"{name} {version(name)}" for name in distributions)


def _judged(record: Record, figure: str) -> bool:
    """Judge, keep and print a record; return whether its bar is met."""
    word, bar, met = "    ", record.bar, None
    if bar is not None:
        met = bool(record.value <= bar if record.most else record.value >= bar)
        word = "PASS" if met else "FAIL"
        limit = f"{bar:g} {record.unit}".rstrip()
        figure += f" (bar: at {'most' if record.most else 'least'} {limit})"
    keep(replace(record, met=met))
    print(f"{word}  {record.what}: {figure}", flush=True)
    return met is not False
