"""The study's page, Markdown with figures, from its rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from . import heterogeneity, statements
from .conclusions import Verdict, evaluate
from .design import stages
from .figures import NAMES, draw_all
from .heterogeneity import OUTCOMES, bootstrapped
from .results import SLICES, Results, results_of

CAPTIONS = {
    "slices": "Spread of lag and CV of gain over the joints, one factor at a time",
    "exponents": "Exponents of the power law and their intervals",
    "collapse": "Spread of lag against the three best single groups",
    "shares": "Share of the boundary against a weakened module; with contact against without",
    "matrices": "P - I of chains of weak servos, and how far their coupling reaches",
    "modes": "Pseudospectrum and slowest patterns of the longest chain",
    "synchrony": "Order over time, time to synchrony and explicit coupling against n",
}


def write_page(rows: Path, page: Path) -> Results:
    """Write the page and, in ``images/`` beside it, its figures."""
    results = results_of(rows)
    draw_all(results, page.parent / "images")
    verdicts = evaluate(results)
    page.write_text("\n".join(_lines(results, verdicts, quick=page.parent.name == "quick")) + "\n")
    return results


def _lines(results: Results, verdicts: list[Verdict], *, quick: bool) -> Iterable[str]:
    yield from INTRODUCTION
    yield from _limits(results)
    yield from ("## The runs", "", *_design(results, quick=quick), "")
    yield f"Rows: `docs/study/rows/long.parquet`, SHA-256 `{results.digest}…`. " + ROWS
    yield from ("", "## Conclusions", "", *_conclusions(verdicts), "")
    yield from ("## The paper's statements", "", *statements.lines(verdicts), "")
    yield from _heterogeneity(results)
    yield from _coupling(results)
    yield from ("## Prediction of synchronisation", "", *_prediction(), "")
    yield from _chains(results)


def figure(name: str) -> str:
    """Return a figure as Markdown."""
    return f"![{CAPTIONS[name]}](images/study-{name}.svg)"


def interval(value: float, low: float, high: float, digits: int = 2) -> str:
    """Return a value with its interval, as the page prints it."""
    shown = (f"{x:.{digits}f}".replace("-", "−") for x in (value, low, high))
    return "{} [{}, {}]".format(*shown)


def markdown(frame: pd.DataFrame, columns: dict[str, str]) -> list[str]:
    """Return columns of a table, floats with three digits."""
    rows = [f"| {' | '.join(columns.values())} |", "|" + "---|" * len(columns)]
    for _, row in frame.iterrows():
        cells = (_cell(row[name]) for name in columns)
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    if np.isnan(value):
        return "–"
    return ("never" if np.isinf(value) else f"{value:.3g}").replace("-", "−")


INTRODUCTION = """# How do heterogeneous couplings affect scalability and synchronisation?

That is the question which the paper leaves open. This page answers it for the body of the twin: what makes the
joints of a chain respond unequally, what the body couples, and how oscillators synchronise through it.
`make study` makes a short form of this page (5 and 9 yaw joints) under `out/study/quick`; `make study LONG=1` makes
this one, and goes on where it was stopped.
""".splitlines()

ROWS = (
    "Each row has its run's `key`, `changes` and `session_id`; `undulog sweep docs/study/plans/PLAN.toml "
    "-o FOLDER` makes it again. Kicks are made by `docs/study/design.py`."
)


def _limits(results: Results) -> Iterable[str]:
    left_out = results.rows[results.rows["drift"] > heterogeneity.MOST_DRIFT]
    failed = int((results.rows["status"] != "done").sum())
    lengths = sorted(results.measures["n"].unique())
    yield from ("## Limits", "")
    yield (
        "- All of it is the twin: links and servos of `snake25` as assumed, flat ground, smoothed friction without "
        "true stiction, one contact point a link. No robot of many joints was measured."
    )
    yield (
        "- No recording at hand determines the servo of such a chain: that of [ArcSnake's motor](calibrating.md#a-real-servo) "
        "leaves all parameters undetermined. The slice of servos takes parameters which others identified from recordings "
        "of single servos on a pendulum (Rhoban/bam, model m1: Coulomb and viscous friction); gear and links stay assumed, and so light "
        "a link on so strong a servo is no robot that exists."
    )
    yield (
        f"- {len(left_out)} rows drift by more than {heterogeneity.MOST_DRIFT:g} a cycle (log gain or rad) and are not "
        f"settled; the fits leave them out, slices show them. {failed} runs failed. "
        "Without contact bending modes decay slowly, so chains have at most 13 yaw joints there, and settle for 60 s."
    )
    yield (
        f"- P was measured for n = {', '.join(f'{n:g}' for n in lengths)} around one gait (0.4 rad, 0.5 Hz, lag π/3, ellipse). "
        "Exponents in n rest on that many lengths; their intervals are those of starts or points, not of other gaits."
    )
    yield (
        "- The power law of part (a) describes the ranges of its design, and no mechanism; groups are compared by how well "
        "each predicts points that it was not fitted to."
    )
    yield (
        "- Part (d) averages over a cycle, takes lags as small and amplitudes as fixed, in units of the feedback ε; "
        "phases within ±1 rad at the start."
    )
    yield ""


def _design(results: Results, *, quick: bool) -> Iterable[str]:
    done = results.rows.groupby("plan")
    yield "| part | sweep | points | simulated s each | done | failed | s of one core each |"
    yield "|---|---|---|---|---|---|---|"
    planned = {one.name: one for one in stages(quick=quick)}  # the last one of a name has all points
    for name, stage in planned.items():
        count = stage.plan.points or np.prod([len(one.values) for one in stage.plan.parameters])
        rows = done.get_group(name) if name in done.groups else results.rows.iloc[:0]
        finished = rows[rows["status"] == "done"]
        part = "b, d" if name.startswith("kicks") else "f" if name == "slice-servo" else "a"
        seconds = f"{finished['duration_s'].median():g}" if len(finished) else "–"
        cost = f"{rows['run_wall'].median():.1f}" if len(rows) else "–"
        failed = len(rows) - len(finished)
        yield f"| {part} | {name} | {count} | {seconds} | {len(finished)} | {failed} | {cost} |"
    total = results.rows["run_wall"].sum() / 3600
    yield ""
    yield (
        f"{len(results.rows)} runs, {total:.1f} hours of a process on a shared computer of two cores; on a quiet one a "
        "run takes a quarter of that."
    )


def _conclusions(verdicts: list[Verdict]) -> Iterable[str]:
    yield "Each is an inequality on an end of a 95 % interval, and a test evaluates all of them."
    yield ""
    yield from ("| name | | inequality | holds |", "|---|---|---|---|")
    for one in verdicts:
        text = one.conclusion.sentence.format(value=interval(one.value, one.low, one.high))
        holds = {True: "yes", False: "**no**", None: "open"}[one.holds]
        yield f"| `{one.conclusion.name}` | {text} | {one.expression} | {holds} |"


def _heterogeneity(results: Results) -> Iterable[str]:
    yield from ("## What makes joints unequal", "", figure("slices"), "")
    yield "One factor at a time, the others as in `weak-servo-pi3` (13 yaw joints, 0.25 N m, 0.4 rad, 0.5 Hz, lag π/3)."
    yield from ("", figure("exponents"), "")
    yield (
        f"Power law over {len(results.points)} settled points of the Sobol design, fitted to logarithms; intervals by "
        "bootstrap over points."
    )
    yield from ("", *_exponent_table(results), "", figure("collapse"), "")
    yield (
        "R² out of sample (ten folds; quadratics of the groups' logarithms) of single groups, of the best pair, and of "
        "the power law of all factors. T_s stall torque, K_p servo gain, A amplitude, m and L mass and length of a "
        "link, t_s = (K_t²/R + b)/(K_p T_s) the time constant of the servo alone, φ the lag, p chosen in each training set."
    )
    yield from ("", *_group_table(results), "", "### Boundary, module, contact", "", figure("shares"), "")
    yield from _share_lines(results)
    yield from ("", "### Friction along and across, laws, and real servos", "", *_slice_tables(results), "")


def _exponent_table(results: Results) -> Iterable[str]:
    yield f"| factor | {' | '.join(OUTCOMES.values())} |"
    yield "|---|---|---|"
    for factor, label in NAMES.items():
        cells = [interval(*results.exponents[y].loc[factor]) for y in OUTCOMES]
        yield f"| {label} | {' | '.join(cells)} |"


def _group_table(results: Results) -> Iterable[str]:
    yield f"| model | {' | '.join(OUTCOMES.values())} |"
    yield "|---|---|---|"
    names = dict.fromkeys(name for y in OUTCOMES for name in results.groups[y].index)
    for name in names:
        cells = [
            interval(*results.groups[y].loc[name]) if name in results.groups[y].index else "–"
            for y in OUTCOMES
        ]
        yield f"| {name} | {' | '.join(cells)} |"


def _share_lines(results: Results) -> Iterable[str]:
    yield "| gain of joint03 | points | share of the boundary, median and interval | its pair has the largest contrast |"
    yield "|---|---|---|---|"
    for weak, group in sorted(results.shares.groupby("weakened"), reverse=True):
        share = interval(*bootstrapped(group["boundary_share"].to_numpy()), digits=4)
        named = "–" if weak == 8.0 else f"{group['named'].sum()} of {len(group)}"
        yield f"| −{100 * (1 - weak / 8):.0f} % | {len(group)} | {share} | {named} |"
    ratio = bootstrapped(results.contact["ratio"].to_numpy())
    yield ""
    yield (
        f"One run each way and no noise, so the shares are those of the twin. The same {len(results.contact)} points "
        f"with contact and without: the spread of lag with contact is {interval(*ratio, digits=1)} times as large (median)."
    )


def _slice_tables(results: Results) -> Iterable[str]:
    for name in ("friction", "law", "servo"):
        column, label = SLICES[name]
        table = results.slice(name).assign(
            lag_deg=lambda t: np.degrees(t["lag_sd"]), gain_percent=lambda t: 100 * t["gain_cv"]
        )
        if not len(table):
            continue
        if name == "servo":
            table[column] = [text.removesuffix(".toml") for text in table[column]]
        columns = {column: label, "lag_deg": "spread of lag °", "gain_percent": "CV of gain %"}
        yield from markdown(table, columns | {"distance_m": "distance m", "drift": "drift a cycle"})
        yield ""


def _coupling(results: Results) -> Iterable[str]:
    yield from ("## What the body couples", "", figure("matrices"), "")
    yield (
        "P = dψ/dψ_c from kicks of 0.05 rad, each command's phase up and down ([method](method.md#coupling)); rows must sum "
        "to 1, and their defect gives the error of an entry. Henrici's departure and the condition of the patterns are those of "
        "I − P without the common phase, as are the rates. *Overshoot* is how far deviations can grow beyond the course of the slowest "
        "pattern; *held out* the error for two random patterns of 0.1 rad over that of joints that keep their response."
    )
    columns = {
        "n": "n",
        "stall": "N m",
        "size": "‖I − P‖",
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
    yield from ("", *markdown(results.measures, columns), "", figure("modes"), "")


def _prediction() -> Sequence[str]:
    """Return the table of part (c), from ``rows/prediction`` where it has been computed."""
    folder = Path(__file__).parent / "rows" / "prediction"
    if not folder.is_dir():
        return ["[Oscillators](oscillators.md#measured-in-the-twin) has the prediction so far, 5 to 13 yaw joints."]
    from .prediction import rows, summary  # type: ignore[import-not-found]

    table = summary(rows(folder))
    return markdown(table, {name: name for name in table.columns})


def _chains(results: Results) -> Iterable[str]:
    yield from ("## Synchronisation and the number of joints", "", figure("synchrony"), "")
    yield (
        "Deviations from the wanted pattern, dθ_i/dt = Σ_j K_ij sin(θ_j − θ_i), 100 starts within ±1 rad; *path*: next "
        "neighbours both ways, 1 ε each; *identified*: K_ij = P_ij; *homogeneous*: its Toeplitz projection, rows and norm as P's. "
        "Synchronous: order parameter above 0.99 for good. *Detuned*: largest steady deviation for a detuning of 1 ε. The gap of the "
        "path is 4 sin²(π/2n), to rounding."
    )
    columns = {
        "n": "n",
        "stall": "N m",
        "kind": "coupling",
        "gap": "slowest ε",
        "median": "median time 1/ε",
        "synchronous": "synchronous",
        "detuned": "detuned rad",
    }
    yield from ("", *markdown(results.chains, columns), "")
    yield "Exponents in n of the median time, with the interval of its starts, and of slowest rate and detuning:"
    yield from ("", "| N m | coupling | lengths | time | slowest rate | detuned |", "|---|---|---|---|---|---|")
    for _, row in results.growth.iterrows():
        time = "never" if np.isnan(row["value"]) else interval(row["value"], row["low"], row["high"])
        cells = (f"{row['gap']:.2f}", f"{row['detuned']:.2f}")
        shown = " | ".join(one.replace("-", "−") for one in cells)
        yield f"| {row['stall']:g} | {row['kind']} | {row['lengths']} | {time} | {shown} |"
    yield from ("", "Explicit coupling between next neighbours that lifts every rate to 0.1 ε:", "")
    columns = {
        "n": "n",
        "stall": "N m",
        "explicit_alone": "no body",
        "explicit": "with this body",
        "explicit_homogeneous": "with the homogeneous one",
    }
    yield from markdown(results.measures, columns)
