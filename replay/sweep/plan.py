"""What a sweep runs: a scenario, the parameters that change, and the design of their points.

A plan is a TOML file::

    scenario = "weak-servo-pi3"
    duration_s = 10.0
    design = "sobol"                  # or "grid" (the default), "random"
    points = 128                      # of "sobol" and "random"

    [parameters."servo.stall_torque"]
    low = 0.1
    high = 1.0
    log = true

    [parameters."gait.horizontal.frequency"]
    values = [0.25, 0.5, 1.0]

A key is that of ``--set``, any value of the scenario's file; or ``robot.`` and a key of the robot's
file, e.g. ``robot.chain.joints``; or ``analysis.`` and an option of ``undulog analyse``. The first
points of a longer random or Sobol design are those of the shorter one, so that a sweep can be
extended.

Source of the design: Sobol', "On the distribution of points in a cube", USSR Comput. Math. Math.
Phys. 7, 1967, scrambled (Owen 1998), by ``scipy.stats.qmc``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np

from undulog.analysis.signals.stretch import Options
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.config import Count, Positive, read_fields
from undulog.capture.common.errors import DescriptionFault, PlanError
from undulog.capture.common.files import read_input
from undulog.capture.common.strict_table import Faults, StrictTable, at_least, shown
from undulog.capture.common.untrusted_text import read_toml
from undulog.sim.scenario.scenario import Kernels

MOST_RUNS = 1_000_000
"""Runs of a plan; all of them and their keys are held in memory."""
_MOST_PARAMETERS = 100
"""Parameters of a plan; SciPy's Sobol' sequence has 21,201 dimensions."""
_MOST_CHARACTERS = 1_000_000_000
"""Of the parameters of all runs, as text: each run's key is a hash of them."""
_LONGEST_VALUE = 1000
"""Characters of one value, as text."""
_LONGEST_NAME = 1000
"""Characters of a key or of the scenario's name."""

_ANALYSIS = Options()


_NUMBER = 24
"""Characters of a double, as text."""


class Design(StrEnum):
    """How the points lie among the parameters' values."""

    GRID = "grid"
    RANDOM = "random"
    SOBOL = "sobol"


@dataclass(frozen=True)
class Parameter:
    """One key and the values that it takes.

    Attributes:
        key: Of the scenario's file, with dots.
        values: The values, or none where it has a range.
        low: Start of the range.
        high: Its end.
        log: Whether points are even in the logarithm.
        integer: Whether values of the range are rounded down to integers.
    """

    key: str
    values: tuple[Any, ...] = ()
    low: float = math.nan
    high: float = math.nan
    log: bool = False
    integer: bool = False

    @property
    def longest(self) -> int:
        """Characters of the longest value, as text."""
        return max((len(_as_text(value)) for value in self.values), default=_NUMBER)

    def at(self, share: float) -> Any:
        """Return the value at a share of the range, or of the list.

        Args:
            share: From 0 up to, not including, 1.
        """
        if self.values:
            return self.values[int(share * len(self.values))]
        if self.log:
            value = self.low * (self.high / self.low) ** share
        else:
            value = self.low + share * (self.high - self.low)
        return math.floor(value) if self.integer else value


@dataclass(frozen=True)
class SweepPlan:
    """What a plan's file holds.

    Attributes:
        scenario: Name of a shipped scenario, or the path of one.
        duration_s: Length of each run [s]; None: the scenario's.
        points: Of a random or Sobol design.
        seeds: Runs of each point, with that many seeds of the sensor noise.
        first_seed: The first of these.
        design_seed: Seed of the design.
        sessions: Whether each run's session is kept.
    """

    scenario: str
    duration_s: Positive | None = None
    design: Design = Design.GRID
    points: Count | None = None
    seeds: Count = 1
    first_seed: Annotated[int, at_least(0)] = 0
    design_seed: Annotated[int, at_least(0)] = 0
    kernels: Kernels = Kernels.NUMPY
    sessions: bool = False
    analysis: Options = _ANALYSIS
    parameters: tuple[Parameter, ...] = ()

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield keys that don't fit together, and what would be valid."""
        if (self.points is None) != (self.design is Design.GRID):
            yield "points", "a number for the designs random and sobol, none for grid"
        if self.duration_s is not None and "duration_s" in {
            parameter.key for parameter in self.parameters
        }:
            yield "duration_s", "left out, since it is a parameter"
        ranges = [parameter.key for parameter in self.parameters if not parameter.values]
        if self.design is Design.GRID and ranges:
            yield "design", f"random or sobol, since {ranges[0]} has a range instead of values"


def read_plan(path: Path) -> SweepPlan:
    """Read a plan.

    Raises:
        InputFileError: If the file can't be read.
        PlanError: If it has faults; lists all of them.
    """
    text = read_input(path)
    try:
        values = read_toml(text.decode())
    except ValueError as error:
        raise PlanError(path, [DescriptionFault("syntax", str(error), "TOML 1.0")]) from error
    faults = Faults()
    top = StrictTable(values, "", faults)
    plan = read_fields(top, SweepPlan, parameters=lambda: _parameters(top))
    top.close()
    if len(plan.scenario) > _LONGEST_NAME or not plan.scenario.isprintable():
        top.fault("scenario", f"a name or path of at most {_LONGEST_NAME} printed characters")
    _check_size(top, plan)
    if problems := faults.all():
        raise PlanError(path, problems)
    return plan


def _check_size(top: StrictTable, plan: SweepPlan) -> None:
    """Note a plan whose runs no computer would hold or end."""
    if len(plan.parameters) > _MOST_PARAMETERS:
        return  # noted before
    runs = (
        plan.points or math.prod(len(parameter.values) for parameter in plan.parameters)
    ) * plan.seeds
    if runs > MOST_RUNS:
        top.fault("points", f"at most {MOST_RUNS} runs", f"{runs:.3g}")
        return
    longest = sum(len(parameter.key) + parameter.longest for parameter in plan.parameters)
    if runs * longest > _MOST_CHARACTERS:
        valid = f"runs and parameters that take at most {_MOST_CHARACTERS} characters as text"
        top.fault("points", valid, f"{runs} runs of {longest} characters")


def _parameters(top: StrictTable) -> tuple[Parameter, ...]:
    name, value = top.look("parameters")
    if not isinstance(value, dict) or not value:
        top.fault(name, 'a table a parameter, e.g. [parameters."servo.stall_torque"]')
        return ()
    table = top.table("parameters")
    names = list(cast("dict[str, Any]", value))
    if len(names) > _MOST_PARAMETERS:
        top.fault(name, f"at most {_MOST_PARAMETERS} parameters", str(len(names)))
        return ()
    parameters = tuple(_parameter(key, table.table(key)) for key in names)
    if "seed" in value:
        table.fault("seed", "left out: seeds and first_seed say it")
    table.close()
    return parameters


def _parameter(key: str, table: StrictTable) -> Parameter:
    if "values" in table:
        _, values = table.look("values")
        if not isinstance(values, list) or not values:
            table.fault("values", "a list of at least one value")
            values = [0.0]
        listed = cast("list[Any]", values)
        for number, entry in enumerate(listed):
            if table.faults.full:
                break
            if not _is_value(entry):
                valid = "a finite number, a text, true, false, or a list or table of them"
                table.faults.add(f"{table.key('values')}[{number}]", shown(entry), valid)
            elif len(_as_text(entry)) > _LONGEST_VALUE:
                valid = f"at most {_LONGEST_VALUE} characters"
                table.faults.add(f"{table.key('values')}[{number}]", shown(entry), valid)
        table.close()
        return Parameter(key, tuple(listed))
    low, high = table.number("low"), table.number("high")
    parameter = Parameter(
        key, (), low, high, table.flag("log", default=False), table.flag("integer", default=False)
    )
    if low >= high:
        table.fault("high", f"above low = {low:g}")
    if parameter.log and low <= 0.0:
        table.fault("low", "above 0, since log is true")
    table.close()
    return parameter


def _is_value(value: object) -> bool:
    """Whether a TOML value is one that JSON has, so neither a date nor NaN or infinity."""
    if isinstance(value, dict):
        return all(map(_is_value, cast("dict[str, object]", value).values()))
    if isinstance(value, list):
        return all(map(_is_value, cast("list[object]", value)))
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, bool | int | str)


def _as_text(value: Any) -> str:
    return value if isinstance(value, str) else str(value)


def points_of(plan: SweepPlan) -> list[dict[str, Any]]:
    """Return the points of a design: key to value of each.

    The first points of a longer random or Sobol design are those of the shorter one.
    """
    keys = [parameter.key for parameter in plan.parameters]
    if plan.design is Design.GRID:
        every = itertools.product(*(parameter.values for parameter in plan.parameters))
        return [dict(zip(keys, values, strict=True)) for values in every]
    count = plan.points or 0
    if plan.design is Design.SOBOL:
        from scipy.stats.qmc import Sobol

        sobol = Sobol(len(keys), rng=np.random.default_rng(plan.design_seed))
        shares: FloatArray = sobol.random_base2(math.ceil(math.log2(count)))[:count]
    else:
        shares = np.random.default_rng(plan.design_seed).random((count, len(keys)))
    return [
        {
            parameter.key: parameter.at(float(share))
            for parameter, share in zip(plan.parameters, row, strict=True)
        }
        for row in shares
    ]


def runs_of(plan: SweepPlan) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield the runs of a plan: the changes of each point with each seed."""
    seeds = range(plan.first_seed, plan.first_seed + plan.seeds)
    yield from itertools.product(points_of(plan), seeds)
