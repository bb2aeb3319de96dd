"""All parts of the study, computed once from its rows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from . import chains, coupling, heterogeneity
from .rows import digest, read_rows


@dataclass(frozen=True)
class Results:
    """What the page prints and the conclusions are about.

    Attributes:
        digest: Of the file of rows.
        points: Settled points of the Sobol design.
        exponents: For each outcome: exponent of each factor, with ends.
        groups: For each outcome: R^2 out of sample of each model, with ends.
        kicked: P and R of each chain.
        measures: One row a chain.
        chains: One row a chain and kind of coupling.
        growth: Exponents in n of each kind of coupling.
    """

    rows: pd.DataFrame
    digest: str
    points: pd.DataFrame
    exponents: dict[str, pd.DataFrame]
    groups: dict[str, pd.DataFrame]
    shares: pd.DataFrame
    contact: pd.DataFrame
    kicked: list[coupling.Kicked]
    measures: pd.DataFrame
    chains: pd.DataFrame
    growth: pd.DataFrame

    def slice(self, name: str) -> pd.DataFrame:
        """Return a slice's rows that are done, in the order of its values."""
        rows = self.rows[(self.rows["plan"] == f"slice-{name}") & (self.rows["status"] == "done")]
        column = SLICES[name][0]
        if column not in rows:  # not run yet
            return rows.assign(**{column: None})
        return rows.sort_values(column, ignore_index=True)


SLICES = {
    "stall": ("stall_torque", "stall torque [N m]"),
    "gain": ("proportional_gain", "servo gain [1/rad]"),
    "lag": ("lag", "lag from joint to joint [rad]"),
    "law": ("law", "law of friction"),
    "friction": ("mu_normal", "friction across, with 0.05 along"),
    "amplitude": ("amplitude", "amplitude [rad]"),
    "frequency": ("frequency_hz", "frequency [Hz]"),
    "joints": ("n", "driven yaw joints"),
    "servo": ("robot", "servo"),
}
"""Name of each slice: its column, and what that is."""


def results_of(path: Path) -> Results:
    """Compute all parts from the study's rows."""
    rows = read_rows(path)
    points = heterogeneity.contact_points(rows)
    kicked = coupling.kicked(rows)
    of_chains = chains.table(kicked)
    return Results(
        rows=rows,
        digest=digest(path),
        points=points,
        exponents={y: heterogeneity.exponents(points, y) for y in heterogeneity.OUTCOMES},
        groups={y: heterogeneity.group_fits(points, y) for y in heterogeneity.OUTCOMES},
        shares=heterogeneity.shares(rows),
        contact=heterogeneity.contact(rows),
        kicked=kicked,
        measures=coupling.measures(kicked),
        chains=of_chains,
        growth=chains.growth_with_n(of_chains),
    )
