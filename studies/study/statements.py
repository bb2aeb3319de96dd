"""Part (e): the paper's own statements, each held against the conclusions."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .conclusions import Verdict


@dataclass(frozen=True)
class Statement:
    """A statement of the paper.

    Attributes:
        verdict: If all conclusions named hold.
        finding: What was found, on top of those conclusions.
        conclusions: Names of those that it rests on; the page elsewhere if there are none.
    """

    text: str
    verdict: str
    finding: str
    conclusions: Sequence[str] = ()


STATEMENTS = tuple(
    Statement(**table)
    for table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text())["statements"]
)


def lines(verdicts: list[Verdict]) -> list[str]:
    """Return the table of statements; a statement whose conclusions fail is open."""
    by_name = {verdict.conclusion.name: verdict for verdict in verdicts}
    rows = ["| the paper | verdict | with |", "|---|---|---|"]
    for statement in STATEMENTS:
        named = [by_name[name] for name in statement.conclusions]
        verdict = statement.verdict if all(v.holds for v in named) else "open"
        with_ = " ".join(
            [*(f"`{v.conclusion.name}`: {v.expression}." for v in named), statement.finding]
        )
        rows.append(f"| {statement.text} | **{verdict}** | {with_} |")
    return rows
