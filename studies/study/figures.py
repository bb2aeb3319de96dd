"""The figures of the study, SVG, drawn from its results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from undulog.analysis.oscillators.laplacian import of_deviations, smallest_singular, spectrum
from undulog.capture.common.arrays import FloatArray

from . import heterogeneity
from .chains import KINDS, STEP
from .coupling import band_energy
from .results import SLICES, Results

COLOURS = dict(zip(KINDS, ("#8c8c8c", "#1c7ed6", "#e8590c", "#1c7ed6", "#e8590c"), strict=True))
STYLES = dict(zip(KINDS, ("-", "-", "-", ":", ":"), strict=True))
NAMES = {
    "stall_torque": "stall torque",
    "proportional_gain": "servo gain",
    "mu_normal": "friction across",
    "mu_tangential": "friction along",
    "n": "driven joints n",
    "lag": "lag from joint to joint",
    "amplitude": "amplitude",
    "frequency_hz": "frequency",
    "box": "law box (ln of the factor)",
    "transeth": "law transeth (ln of the factor)",
}
"""Of factors, for readers."""
LOGARITHMIC = {
    "stall": (0.15, 0.4, 1.5),
    "gain": (4, 8, 16, 32),
    "friction": (0.05, 0.2, 1),
    "joints": (3, 5, 9, 17, 50),
}
"""Ticks of the slices whose axis is logarithmic."""
LENGTHS = (3, 5, 9, 13, 17, 25, 50)


def log_axis(axis: Axis, ticks: Sequence[float]) -> None:
    """Make an axis logarithmic, with ticks at these values alone."""
    ax = axis.axes
    (ax.set_xscale if axis is ax.xaxis else ax.set_yscale)("log")
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_locator(NullLocator())


def draw_all(results: Results, folder: Path) -> list[str]:
    """Draw all figures; return their names."""
    folder.mkdir(parents=True, exist_ok=True)
    mpl.rcParams.update({"svg.hashsalt": "study", "font.size": 9, "axes.spines.top": False})
    mpl.rcParams.update({"axes.spines.right": False, "figure.constrained_layout.use": True})
    drawn = []
    for name, draw in FIGURES.items():
        figure = draw(results)
        figure.savefig(folder / f"study-{name}.svg", metadata={"Date": None})
        plt.close(figure)
        drawn.append(name)
    return drawn


def slices(results: Results) -> Figure:
    """Spread of lag and CV of gain, one factor at a time."""
    named = [name for name in SLICES if name != "servo"]
    figure, axes = plt.subplots(2, 4, figsize=(10, 4.6), sharey=True)
    for ax, name in zip(axes.flat, named, strict=True):
        column, label = SLICES[name]
        table = results.slice(name)
        x = table[column] if name != "law" else np.arange(len(table))
        ax.plot(x, np.degrees(table["lag_sd"]), "o-", color="#1c7ed6", label="spread of lag [°]")
        ax.plot(x, 100 * table["gain_cv"], "s--", color="#e8590c", label="CV of gain [%]")
        log_axis(ax.yaxis, (1, 3, 10, 30))
        if name == "law":
            ax.set_xticks(x, table["law"], rotation=20)
        elif name in LOGARITHMIC:
            log_axis(ax.xaxis, LOGARITHMIC[name])
        ax.set_xlabel(label)
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def exponents(results: Results) -> Figure:
    """Exponents of the power law with their intervals."""
    figure, ax = plt.subplots(figsize=(7, 3.6))
    for k, (outcome, label) in enumerate(heterogeneity.OUTCOMES.items()):
        table = results.exponents[outcome].loc[list(NAMES)]
        y = -np.arange(len(table)) - 0.25 * k
        error = np.abs(table[["low", "high"]].to_numpy().T - table["value"].to_numpy())
        ax.errorbar(table["value"], y, xerr=error, fmt="o", capsize=3, label=label)
    ax.set_yticks(-np.arange(len(table)), [NAMES[name] for name in table.index])
    ax.axvline(0.0, color="#8c8c8c", lw=0.8)
    ax.set_xlabel("exponent, 95 % interval")
    ax.legend(frameon=False)
    return figure


def collapse(results: Results) -> Figure:
    """The spread of lag against single groups."""
    points = results.points
    names = list(
        results.groups["lag_sd"].loc[list(heterogeneity.GROUPS)]["value"].nlargest(3).index
    )
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.4), sharey=True)
    for ax, name in zip(axes, names, strict=True):
        x = np.asarray(heterogeneity.GROUPS[name](points), dtype=float)
        shown = ax.scatter(x, points["lag_sd"], c=points["n"], s=14, cmap="viridis", norm="log")
        order = np.argsort(x)
        X = heterogeneity.quadratic(np.log(x))
        fit = np.linalg.lstsq(X, np.log(points["lag_sd"].to_numpy()), rcond=None)[0]
        ax.plot(x[order], np.exp(X @ fit)[order], color="#e8590c")
        log_axis(ax.xaxis, _decades(x))
        ax.set_yscale("log")
        R2 = results.groups["lag_sd"].loc[name, "value"]
        ax.set_title(f"R² out of sample {R2:.2f}", fontsize=9)
        ax.set_xlabel(name, fontsize=8)
    axes[0].set_ylabel("spread of lag [rad]")
    bar = figure.colorbar(shown, ax=axes, label="n")
    log_axis(bar.ax.yaxis, LENGTHS)
    return figure


def _decades(values: FloatArray) -> list[float]:
    """Return 1, 2, 5, 10, ... within the values' range."""
    every = [m * 10.0**k for k in range(-5, 5) for m in (1, 2, 5)]
    return [tick for tick in every if values.min() <= tick <= values.max()]


def shares(results: Results) -> Figure:
    """What reversal says of a weakened module, and what contact makes of the spread."""
    figure, (ax, beside) = plt.subplots(1, 2, figsize=(8.5, 3.2))
    table = results.shares
    shown = ax.scatter(
        1 - table["weakened"] / 8.0, table["boundary_share"], c=table["n"], cmap="viridis"
    )
    figure.colorbar(shown, ax=ax, label="n")
    ax.set_xlabel("gain of joint03 lower by")
    ax.set_ylabel("share of the boundary")
    beside.scatter(results.contact["free"], results.contact["ground"], c=results.contact["n"])
    ends = np.array([results.contact["free"].min(), results.contact["ground"].max()])
    beside.plot(ends, ends, color="#8c8c8c", lw=0.8)
    beside.set(xscale="log", yscale="log")
    beside.set_xlabel("spread of lag without contact [rad]")
    beside.set_ylabel("with contact [rad]")
    return figure


def matrices(results: Results) -> Figure:
    """P - I of each chain of weak servos, and the reach of its coupling."""
    weak = [candidate for candidate in results.kicked if candidate.stall == 0.25]
    figure, axes = plt.subplots(1, len(weak) + 1, figsize=(2.6 * len(weak) + 3.2, 2.9))
    for ax, chain in zip(axes, weak, strict=False):
        ax.spines[:].set_visible(True)
        shown = ax.imshow(
            chain.P - np.eye(chain.n),
            cmap="RdBu_r",
            vmin=-0.25,
            vmax=0.25,
            extent=(0.5, chain.n + 0.5, chain.n + 0.5, 0.5),
        )
        ax.set_title(f"P − I, n = {chain.n}", fontsize=9)
        ax.set_xlabel("command turned")
    axes[0].set_ylabel("joint")
    figure.colorbar(shown, ax=axes[len(weak) - 1])
    for chain in results.kicked:
        reach = np.arange(1, chain.n)
        style = "o-" if chain.stall == 0.25 else "s--"
        energy = [band_energy(chain.P, int(k)) for k in reach]
        axes[-1].plot(reach, energy, style, ms=3, label=f"n = {chain.n}, {chain.stall:g} N m")
    log_axis(axes[-1].xaxis, (1, 2, 4, 8, 16, 32))
    axes[-1].set(xlabel="within |i − j|", ylabel="share of off-diagonal energy")
    axes[-1].legend(frameon=False, fontsize=7)
    return figure


def modes(results: Results) -> Figure:
    """Pseudospectrum and slowest pattern of the longest chain of weak servos."""
    chain = max((k for k in results.kicked if k.stall == 0.25), key=lambda k: k.n)
    figure, (ax, beside) = plt.subplots(1, 2, figsize=(9, 3.4))
    values = np.linalg.eigvals(of_deviations(chain.P))
    real = np.linspace(values.real.min() - 0.15, values.real.max() + 0.15, 81)
    top = float(np.abs(values.imag).max()) + 0.15
    imag = np.linspace(-top, top, 81)
    level = np.log10(smallest_singular(chain.P, real, imag)).T
    lines = ax.contour(real, imag, level, levels=np.arange(-4.0, 0.0, 0.5), cmap="viridis")
    ax.clabel(lines, fontsize=7)
    ax.plot(values.real, values.imag, "k.", ms=6)
    ax.axvline(0.0, color="#8c8c8c", lw=0.8)
    ax.set(xlabel="real part of the rate [ε]", ylabel="imaginary part [ε]")
    ax.set_title(f"log10 of the change of P that makes it a rate, n = {chain.n}", fontsize=9)
    decomposition = spectrum(chain.P)
    for k in np.flatnonzero(decomposition.rates.imag >= 0.0)[:3]:
        pattern = decomposition.patterns[:, k]
        pattern = (pattern / pattern[np.argmax(np.abs(pattern))]).real
        beside.plot(
            np.arange(1, chain.n + 1), pattern, "o-", label=f"{decomposition.rates[k]:.3f} ε"
        )
    beside.set(xlabel="joint, from the head", ylabel="pattern, largest = 1")
    beside.legend(frameon=False, fontsize=8)
    return figure


def synchrony(results: Results) -> Figure:
    """Order parameter over time, time to synchrony, and explicit coupling, against n."""
    figure, (first, second, third) = plt.subplots(1, 3, figsize=(11, 3.4))
    weak = results.chains[results.chains["stall"] == 0.25]
    longest = weak[weak["n"] == weak["n"].max()]
    for _, row in longest.iterrows():
        t = STEP * np.arange(len(row["order"]))
        look = {"color": COLOURS[row["kind"]], "ls": STYLES[row["kind"]]}
        first.plot(t[1:], 1.0 - row["order"][1:], label=row["kind"], **look)
    first.set(xscale="log", yscale="log", xlabel="time [1/ε]", ylabel="1 − order parameter")
    first.set_title(f"n = {int(weak['n'].max())}", fontsize=9)
    first.legend(frameon=False, fontsize=7)
    for kind in KINDS[:3]:
        rows = weak[weak["kind"] == kind].sort_values("n")
        second.plot(rows["n"], rows["median"], "o-", color=COLOURS[kind], label=kind)
    log_axis(second.xaxis, LENGTHS)
    log_axis(second.yaxis, _decades(weak.loc[weak["kind"] == "path", "median"].to_numpy()))
    second.set(xlabel="n", ylabel="median time to synchrony [1/ε]")
    second.legend(frameon=False, fontsize=7)
    for stall, group in results.measures.sort_values("n").groupby("stall"):
        third.plot(group["n"], group["explicit"], "o-", label=f"body, {stall:g} N m")
    every = results.measures.sort_values("n")
    third.plot(every["n"], every["explicit_alone"], "k--", lw=1, label="no body: 0.1/(4 sin² π/2n)")
    log_axis(third.xaxis, LENGTHS)
    log_axis(third.yaxis, _decades(results.measures["explicit"].to_numpy()))
    third.set(xlabel="n", ylabel="explicit coupling needed [ε]")
    third.legend(frameon=False, fontsize=7)
    return figure


FIGURES: dict[str, Callable[[Results], Figure]] = {
    "slices": slices,
    "exponents": exponents,
    "collapse": collapse,
    "shares": shares,
    "matrices": matrices,
    "modes": modes,
    "synchrony": synchrony,
}
