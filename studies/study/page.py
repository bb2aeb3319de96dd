"""The study's page, Markdown with figures, from its rows and the text of ``page.txt``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

import numpy as np
import pandas as pd

from . import heterogeneity, statements
from .conclusions import Verdict, evaluate
from .design import stages
from .figures import NAMES, draw_all
from .heterogeneity import OUTCOMES, bootstrapped
from .results import SLICES, Results, results_of

HERE = Path(__file__).parent
MEASURES = {
    "n": "n",
    "stall": "N m",
    "size": "‖I − P‖",
    "diagonal_inside": "diagonal inside",
    "band1": "within 1",
    "band3": "within 3",
    "reach90": "90 % within",
    "henrici": "Henrici",
    "condition": "condition",
    "amplification": "overshoot",
    "gap": "slowest ε",
    "homogeneous_gap": "homogeneous",
    "strong": "strong",
    "row_defect": "rows off 1",
    "held_out": "held out",
}
CHAINS = {
    "n": "n",
    "stall": "N m",
    "kind": "coupling",
    "gap": "slowest ε",
    "median": "median time 1/ε",
    "synchronous": "synchronous",
    "detuned": "detuned rad",
}
EXPLICIT = {
    "n": "n",
    "stall": "N m",
    "explicit_alone": "no body",
    "explicit": "with this body",
    "explicit_homogeneous": "with the homogeneous one",
}
LOOP = {
    "n": "n",
    "engine": "engine",
    "law": "friction",
    "stall": "N m",
    "eps": "ε 1/s",
    "kick": "kick rad",
    "K": "K 1/s",
    "until_s": "after s",
}
SHARES = {
    "error": "error %",
    "+-": "± (patterns)",
    "of P": "± (of P)",
    "worst": "worst pattern",
    "at any time": "at any time",
    "still": "nothing moves",
    "error/still": "ratio",
    "toeplitz": "Toeplitz",
    "below": "below it",
}
ANSWER = ("neutral", "helps", "path", "body-and-path", "heterogeneity", "long-chains")
"""Conclusions that answer the question, those that hold."""


def write_page(rows: Path, page: Path, *, quick: bool) -> Results:
    """Write the page and, in ``images/`` beside it, its figures."""
    results = results_of(rows)
    draw_all(results, page.parent / "images")
    verdicts = evaluate(results)
    by_name = {verdict.conclusion.name: verdict for verdict in verdicts}
    parts = _numbers(results) | {
        "planned": f"{sum(_planned(quick=quick).values())}",
        "answer": [_sentence(by_name[name]) for name in ANSWER if by_name[name].holds],
        "design": _design(results, quick=quick),
        "conclusions": _conclusions(verdicts),
        "statements": statements.lines(verdicts),
        "exponents": _exponents(results),
        "groups": _groups(results),
        "shares": _shares(results),
        "slices": _slices(results),
        "measures": markdown(results.measures, MEASURES),
        "prediction": _prediction(),
        "chains": markdown(results.chains, CHAINS),
        "growth": _growth(results),
        "explicit": markdown(results.measures, EXPLICIT),
    }
    text = {
        name: part if isinstance(part, str) else "\n".join(part) for name, part in parts.items()
    }
    page.write_text(Template((HERE / "page.txt").read_text()).substitute(text))
    return results


def _numbers(results: Results) -> dict[str, Iterable[str]]:
    rows = results.rows
    pairs = int((rows["plan"] == "pair-ground").sum())
    return {
        "runs": f"{len(rows)}",
        "hours": f"{rows['run_wall'].sum() / 3600:.1f}",
        "digest": results.digest,
        "source": ", ".join(sorted(set(rows["source"]))),
        "unsettled": f"{(rows['drift'] > heterogeneity.MOST_DRIFT).sum()}",
        "most_drift": f"{heterogeneity.MOST_DRIFT:g}",
        "failed": f"{(rows['status'] != 'done').sum()}",
        "lengths": ", ".join(f"{n:g}" for n in sorted(results.measures["n"].unique())),
        "points": f"{len(results.points)}",
        "pairs": f"{pairs}",
        "missing": f"{pairs - len(results.contact)}",
        "free_most": f"{np.degrees(heterogeneity.settled(rows, 'pair-free')['lag_sd'].max()):.0f}",
        "contacts": f"{len(results.contact)}",
        "ratio": interval(*heterogeneity.short_ratio(results.contact), digits=1),
        "by_length": ", ".join(
            f"{ratio['ratio'].median():.2g} at n = {n:g} ({len(ratio)} points)"
            for n, ratio in results.contact.groupby("n")
        ),
    }


def interval(value: float, low: float, high: float, digits: int = 2) -> str:
    """Return a value with its interval, as the page prints it; one number where it has none."""
    if np.isnan(value):
        return "–"
    small = abs(value) < 10.0**-digits
    shown = [f"{x:.2g}" if small else f"{x:.{digits}f}" for x in (value, low, high)]
    text = shown[0] if low == high else "{} [{}, {}]".format(*shown)
    return text.replace("-", "−")


def markdown(frame: pd.DataFrame, columns: dict[str, str]) -> list[str]:
    """Return columns of a table, floats with three digits."""
    cells = [[_cell(row[name]) for name in columns] for _, row in frame.iterrows()]
    return table(list(columns.values()), cells)


def table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return a table in Markdown."""
    lines = [f"| {' | '.join(row)} |" for row in (names, *rows)]
    return [lines[0], "|" + "---|" * len(names), *lines[1:]]


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    if np.isnan(value):
        return "–"
    return ("never" if np.isinf(value) else f"{value:.3g}").replace("-", "−")


def _planned(*, quick: bool) -> dict[str, int]:
    """Return how many runs each sweep has."""
    # The last of a name has all points.
    plans = {stage.name: stage.plan for stage in stages(quick=quick)}
    return {
        name: plan.points or math.prod(len(parameter.values) for parameter in plan.parameters)
        for name, plan in plans.items()
    }


def _design(results: Results, *, quick: bool) -> list[str]:
    cells = []
    for name, count in _planned(quick=quick).items():
        rows = results.rows[results.rows["plan"] == name]
        done = rows[rows["status"] == "done"]
        part = "coupling" if name.startswith("kicks") else "heterogeneity"
        times = (
            f"{rows[k].median():.3g}" if len(rows) else "–" for k in ("duration_s", "run_wall")
        )
        simulated, wall = times
        failed = f"{len(rows) - len(done)}"
        cells.append([part, name, f"{count}", simulated, f"{len(done)}", failed, wall])
    names = ["part", "sweep", "points", "simulated s each", "done", "failed", "wall s each"]
    return table(names, cells)


def _sentence(verdict: Verdict) -> str:
    return verdict.conclusion.sentence.format(
        value=interval(verdict.value, verdict.low, verdict.high)
    )


def _conclusions(verdicts: list[Verdict]) -> list[str]:
    holds = {True: "yes", False: "**no**", None: "open"}
    cells = [
        [
            f"`{verdict.conclusion.name}`",
            _sentence(verdict),
            verdict.expression,
            holds[verdict.holds],
        ]
        for verdict in verdicts
    ]
    return table(["name", "", "inequality", "holds"], cells)


def _exponents(results: Results) -> list[str]:
    cells = [
        [label, *(interval(*results.exponents[y].loc[factor]) for y in OUTCOMES)]
        for factor, label in NAMES.items()
    ]
    return table(["factor", *OUTCOMES.values()], cells)


def _groups(results: Results) -> list[str]:
    names = [*heterogeneity.GROUPS, heterogeneity.SCALED, heterogeneity.ALL, "none"]
    kinds = [(y, shape) for y in OUTCOMES for shape in ("", heterogeneity.SHAPE)]
    cells = [
        [name]
        + [
            interval(*results.groups[y].loc[name + shape])
            if name + shape in results.groups[y].index
            else "–"
            for y, shape in kinds
        ]
        for name in names
    ]
    return table(["group", *(OUTCOMES[y] + shape for y, shape in kinds)], cells)


def _shares(results: Results) -> list[str]:
    cells = []
    for weak, group in sorted(results.shares.groupby("weakened"), reverse=True):
        share = interval(*bootstrapped(group["boundary_share"].to_numpy()), digits=4)
        named = "–" if weak == heterogeneity.SOUND else f"{group['named'].sum()} of {len(group)}"
        cells.append([f"−{100 * (1 - weak / 8):.0f} %", f"{len(group)}", share, named])
    names = ["gain of joint03", "points", "share of the boundary, median"]
    return table([*names, "its pair has the largest contrast"], cells)


def _slices(results: Results) -> list[str]:
    lines = []
    for name in ("friction", "law", "servo"):
        column, label = SLICES[name]
        rows = results.slice(name).assign(
            lag_deg=lambda t: np.degrees(t["lag_sd"]), gain_percent=lambda t: 100 * t["gain_cv"]
        )
        if name == "servo":
            rows[column] = [text.removesuffix(".toml") for text in rows[column]]
        columns = {column: label, "lag_deg": "spread of lag °", "gain_percent": "CV of gain %"}
        lines += markdown(rows, columns | {"distance_m": "distance m", "drift": "drift a cycle"})
        lines.append("")
    return lines[:-1]


def _prediction() -> list[str]:
    """Return the tables of ``prediction.py``, from ``rows/prediction`` where it was computed."""
    folder = HERE / "rows" / "prediction"
    if not folder.is_dir():
        link = "[Oscillators](explanation/oscillators.md#measured-in-the-twin)"
        return [f"{link} has what has been predicted so far: 5 to 13 yaw joints."]
    from .prediction import PATTERNS, STANDARD, rows, summary

    kicks = rows(folder).query("kind == 'kick'")
    count = kicks.groupby(list(LOOP), sort=True).size().rename("patterns").reset_index()
    lines = summary(kicks).merge(count, on=list(LOOP))
    shares = [
        *(name for name in SHARES if name not in ("error/still", "below")),
        "left",
        "foretold",
    ]
    lines[shares] = lines[shares].mul(100.0).map(lambda x: "–" if np.isnan(x) else f"{x:.1f}")
    coupled = lines.K > 0
    usual = (lines.patterns == PATTERNS) & (lines.kick == STANDARD.kick) & ~coupled
    shown = coupled | (lines.until_s > STANDARD.until_s)
    left = LOOP | {"left": "left %", "foretold": "foretold %", "patterns": "patterns"}
    return [
        *markdown(lines[usual], {n: LOOP[n] for n in ("n", "engine", "law")} | SHARES),
        "",
        "Explicit coupling K of next neighbours: none, half of what is foretold as needed, all.",
        "",
        *markdown(
            lines[shown],
            {n: left[n] for n in ("n", "K", "until_s")} | dict(list(left.items())[-3:]),
        ),
        "",
        "Where it breaks: weaker servos, larger kicks, faster feedback.",
        "",
        *markdown(lines[~usual & ~shown], LOOP | SHARES),
    ]


def _growth(results: Results) -> list[str]:
    cells = []
    for _, row in results.growth.iterrows():
        exponent = interval(row["value"], row["low"], row["high"])
        time = "never" if np.isnan(row["value"]) else exponent
        rate, detuned = (f"{row[k]:.2f}".replace("-", "−") for k in ("gap", "detuned"))
        shown = rate if row["settles"] else "–"
        against = interval(*(row[f"against_{end}"] for end in ("value", "low", "high")))
        first = [f"{row['stall']:g}", row["kind"], f"{row['lengths']}", time]
        cells.append([*first, against if row["kind"] != "path" else "–", shown, detuned])
    names = ["N m", "coupling", "lengths", "time", "less that of the path", "slowest rate"]
    return table([*names, "detuned"], cells)
