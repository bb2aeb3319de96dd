"""Indices of heterogeneity as a table."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ...common import formats
from ...common.estimate import Estimate
from ...common.formats import scaled
from ..shown import Column, Ends, ShownNumber, Table, p_cell
from .result import Index


def index_table(indices: Mapping[str, Index]) -> Table[tuple[str, Index]]:
    """Heterogeneity indices."""

    def value(index: Index) -> Estimate:
        return scaled(Estimate(index.value, index.ci95), math.degrees(1) if rad(index) else 1.0)

    def rad(index: Index) -> bool:
        return index.unit == "rad"

    def on_page(index: Index, number: float | None) -> ShownNumber:
        unit = {"rad": "°", "1": ""}.get(index.unit, index.unit)
        return ShownNumber(Estimate(number), formats.decimals_for([value(index)], least=0), unit)

    def ends(index: Index) -> Ends | None:
        ci95 = value(index).ci95
        return None if ci95 is None else Ends(on_page(index, ci95[0]), on_page(index, ci95[1]))

    columns: list[Column[tuple[str, Index]]] = [
        Column("index", "index", lambda row: row[0], kind="code"),
        Column(None, "what it measures", lambda row: row[1].label, kind="sentence"),
        Column("value (95 %)", None, lambda row: value(row[1]), (4, 0)),
        Column(None, "value", lambda row: on_page(row[1], value(row[1]).value)),
        Column(None, "95 % interval", lambda row: ends(row[1])),
        Column("unit", None, lambda row: "°" if rad(row[1]) else row[1].unit, spare=2),
        Column("p", "p", lambda row: p_cell(row[1].p)),
        Column("what", None, lambda row: row[1].label, kind="word", spare=1),
    ]
    return Table(columns, list(indices.items()))
