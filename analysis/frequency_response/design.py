"""The facts of a planned multisine, as its sessions carry them in the record ``undulog.plan``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from undulog.capture.common.errors import DataError

KIND = "odd-random-phase"
"""Value of ``kind`` in the record of each run."""

MOST_LINES = 512
HIGHEST_LINE = 100_000
LONGEST_PERIOD_S = 1e4

Inputs = Literal["same", "orthogonal"]


@dataclass(frozen=True)
class MultisineDesign:
    """What one run of a multisine experiment commands.

    Attributes:
        plan: Identifier of the experiment; empty where only the commands are known.
        period_s: After which the commands repeat [s].
        periods: Steady periods that were planned.
        lines: Excited multiples of 1 / ``period_s``, ascending.
        realisation: Number of the realisation that the run belongs to; -1 where it isn't known.
        inputs: Whether all joints have the same command.
    """

    plan: str
    period_s: float
    periods: int
    lines: tuple[int, ...]
    realisation: int
    inputs: Inputs


def planned_design(record: Mapping[str, str], where: str) -> MultisineDesign | None:
    """Read the design of a session.

    Args:
        record: Its record ``undulog.plan``; empty without.
        where: The session, for messages.

    Returns:
        None where it is of no multisine over a band.

    Raises:
        DataError: If a field of the record is missing or wrong.
    """
    if record.get("kind") != KIND:
        return None

    def number(field: str, least: float, most: float) -> float:
        text = record.get(field, "")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise DataError(
                f"{where}: {field} of its record undulog.plan is {text[:40]!r}; expected a number "
                f"from {least:g} to {most:g}"
            )
        return value

    text = record.get("lines", "")
    words = text.split(maxsplit=MOST_LINES)
    sound = len(words) <= MOST_LINES and all(w.isascii() and w.isdigit() for w in words)
    lines = tuple(int(word[:9]) for word in words) if sound else ()
    if not lines or sorted(set(lines)) != [*lines] or not 0 < lines[0] <= lines[-1] <= HIGHEST_LINE:
        raise DataError(
            f"{where}: lines of its record undulog.plan are {text[:40]!r}; expected up to "
            f"{MOST_LINES} ascending whole numbers from 1 to {HIGHEST_LINE}"
        )
    inputs = record.get("inputs", "")
    if inputs not in ("same", "orthogonal"):
        raise DataError(
            f"{where}: inputs of its record undulog.plan is {inputs[:40]!r}; expected 'same' or "
            "'orthogonal'"
        )
    return MultisineDesign(
        plan=record.get("plan_id", ""),
        period_s=number("period_s", 1e-3, LONGEST_PERIOD_S),
        periods=int(number("periods", 1, 1e6)),
        lines=lines,
        realisation=int(number("realisation", 0, 1e6)),
        inputs="same" if inputs == "same" else "orthogonal",
    )
