"""The joints of a dry run as a table: angles in degrees, demands beside their share of a limit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from .dry_run_tally import JointDemand

_NOTHING = "-"
_GAP = 2


@dataclass(frozen=True)
class _Column:
    """One column.

    Attributes:
        title: Its head, with the unit.
        cell: What stands in it.
        spare: A narrow terminal goes without the columns of the greatest number first; 0 stays.
    """

    title: str
    cell: Callable[[JointDemand], str]
    spare: int = 0


def _number(value: float, form: str) -> str:
    return _NOTHING if math.isnan(value) else format(value, f"z{form}")


def _degrees(value: float, form: str = ".1f") -> str:
    return _number(math.degrees(value), form)


def _share(name: str) -> Callable[[JointDemand], str]:
    def cell(joint: JointDemand) -> str:
        (found,) = (demand for demand in joint.demands if demand.name == name)
        return _number(100.0 * found.share, ".0f")

    return cell


_COLUMNS = (
    _Column("joint", lambda joint: joint.name),
    _Column("from °", lambda joint: _degrees(joint.least), 2),
    _Column("to °", lambda joint: _degrees(joint.greatest), 2),
    _Column("%", _share("range")),
    _Column("°/s", lambda joint: _degrees(joint.rate, ".0f"), 1),
    _Column("%", _share("rate")),
    _Column("°/s²", lambda joint: _degrees(joint.acceleration, ".0f"), 5),
    _Column("error °", lambda joint: _degrees(joint.tracking_error), 1),
    _Column("%", _share("tracking error")),
    _Column("N m", lambda joint: _number(joint.torque_peak, ".3f"), 1),
    _Column("%", _share("torque")),
    _Column("rms", lambda joint: _number(joint.torque_rms, ".3f"), 4),
    _Column("A", lambda joint: _number(joint.current_peak, ".2f"), 1),
    _Column("%", _share("current")),
    _Column("net J", lambda joint: _number(joint.energy_net_j, ".3f"), 3),
    _Column("abs J", lambda joint: _number(joint.energy_abs_j, ".3f"), 4),
    _Column("el. J", lambda joint: _number(joint.energy_el_j, ".3f"), 3),
    _Column("clamped", lambda joint: _number(joint.clamped or math.nan, ".0%"), 3),
)


def joint_table(joints: Sequence[JointDemand], width: int) -> Iterator[str]:
    """The table.

    Args:
        joints: What is asked of each.
        width: Characters in a line; columns that may go, go where they don't fit.

    Yields:
        What the percentages are of, the heads, a line for each joint.
    """
    columns, left = list(_COLUMNS), ""
    while _needed(joints, columns) > width and (most := max(one.spare for one in columns)):
        columns = [one for one in columns if one.spare != most]
        left = "; the terminal is too narrow for all of it, --json has it"
    yield (
        "% of the limit: half the range, [safety]'s rate, tracking error and current, the servo's "
        f"stall torque{left}"
    )
    widths = [_width(joints, one) for one in columns]
    for cells in (
        [one.title for one in columns],
        *([one.cell(joint) for one in columns] for joint in joints),
    ):
        first, *others = zip(cells, widths, strict=True)
        line = first[0].ljust(first[1])
        yield line + "".join(f"{cell:>{wide + _GAP}}" for cell, wide in others)


def _width(joints: Sequence[JointDemand], column: _Column) -> int:
    return max(len(column.title), *(len(column.cell(joint)) for joint in joints))


def _needed(joints: Sequence[JointDemand], columns: Sequence[_Column]) -> int:
    return sum(_width(joints, one) + _GAP for one in columns) - _GAP
