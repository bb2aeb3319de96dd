"""The page of benchmarks, as Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

HEAD = """# Benchmarks

What undulog costs beside other programs that do the same work. `make bench` measures it on the
machine at hand and writes this page and `benchmarks.json`, which has every turn. `--quick` makes
the runs short and `--only NAME` measures one bench: `python bench/all.py --quick --only reading`.

Ratio
: our cost over the peer's for the same work: below 1, undulog is cheaper. Both take turns in one
  run. The figure is the geometric mean of the ratios of the turns, with its 95 % interval
  (Student's, of the logarithms). Without a peer the column has the quantity itself.

Ours, peer
: medians of the costs.

Bar
: what the bench fails at; it is set for the full run.
"""

QUICK = """
```{note}
Some rows are from short runs, on a machine that was busy with other work: `quick` and the load in
the table of runs. Their intervals are wide, and the cost of starting weighs more in them than in a
long run. A busy machine disturbs times of the wall clock; ratios of processor time it hardly does.
```
"""


def page_of(data: dict[str, Any], missing: Sequence[str] = ()) -> str:
    """Return the page of the benches, by name, and name those that were not run."""
    parts = [HEAD]
    if any(bench["quick"] for bench in data.values()):
        parts.append(QUICK)
    parts += [
        "\n## Figures\n",
        "| bench | what | ours | peer | ratio or figure | bar | met |",
        "|---|---|---|---|---|---|---|",
    ]
    parts += [
        _row(name, row, quick=bench["quick"])
        for name, bench in data.items()
        for row in bench["rows"]
    ]
    parts += [f"| {name} | | | | not run yet | | |" for name in missing]
    parts += [
        "\n## Runs\n",
        "| bench | command | date (UTC) | length | load | took | exit code | machine |",
        "|---|---|---|---|---|---|---|---|",
    ]
    hosts = list(dict.fromkeys((bench["machine"], bench["versions"]) for bench in data.values()))
    parts += [
        f"| {name} | `{bench['command']}` | {bench['date'][:16].replace('T', ' ')} "
        f"| {'quick' if bench['quick'] else 'full'} | {bench['load']} | {bench['took_s']:.0f} s "
        f"| {bench['exit']} | {_letter(hosts.index((bench['machine'], bench['versions'])))} |"
        for name, bench in data.items()
    ]
    parts += ["\n## Machines and versions\n"]
    for k, (machine, versions) in enumerate(hosts):
        parts += [f"{_letter(k)}\n: {machine}; {versions}\n"]
    return "\n".join(parts)


def _letter(number: int) -> str:
    return chr(ord("A") + number)


def _row(name: str, row: dict[str, Any], *, quick: bool) -> str:
    unit = row["cost_unit"]
    ours, theirs = (
        f"{statistics.median(row[key]):.3g} {unit}" if row[key] else ""
        for key in ("ours", "theirs")
    )
    peer = f"{row['peer']}: {theirs}" if theirs else row["peer"]
    missed = "no (short run)" if quick else "**no**"
    met = {True: "yes", False: missed, None: ""}[row["met"]]
    cells = (name, row["what"], ours, peer, _figure(row), _bar(row), met)
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _figure(row: dict[str, Any]) -> str:
    if row["value"] is None:
        return row["note"]
    figure = f"{_number(row['value'])} {row['unit']}".rstrip()
    if row["low"] is not None:
        figure += f" ({row['low']:.3g} to {row['high']:.3g})"
    return figure


def _bar(row: dict[str, Any]) -> str:
    if row["bar"] is None:
        return ""
    sign = "at most" if row["most"] else "at least"
    return f"{sign} {_number(row['bar'])} {row['unit']}".rstrip()


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
