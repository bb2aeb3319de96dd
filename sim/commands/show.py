"""Command ``sim show``: what a scenario is."""

from __future__ import annotations

import tomllib
from json import dumps
from typing import Any, cast

from undulog.capture.common.console import UNLIMITED, Column, emit, table

_COLUMNS = (Column("key", left=True), Column("value", left=True), Column("unit", left=True))
_HEAD = ("name", "description", "robot")


def show(scenario: str, /, *, json: bool = False) -> None:
    """Show a scenario: robot, gait, world and sensors, every value with its unit, defaults too.

    The keys are those of the scenario file, and of `undulog sim run --set KEY=VALUE`.

    Example: `undulog sim show weak-servo-pi3`

    Args:
        scenario: Name of a shipped scenario (see `undulog sim list`), or a TOML file.
        json: Print one JSON object: each key with value and unit.
    """
    from ..scenario.scenario_file import load_scenario
    from ..scenario.units import leaves, unit_of

    found = load_scenario(scenario)
    every = dict(leaves(tomllib.loads(found.toml())))
    values = {
        key: {"value": value, "unit": unit_of(key) if _is_number(value) else ""}
        for key, value in every.items()
        if key not in _HEAD
    }
    robot = found.robot
    facts = {
        "name": found.name,
        "description": found.description,
        "robot": {"name": robot.name, "joints": len(robot.joints), "mass_kg": robot.total_mass},
        "values": values,
    }
    rows = [
        [(text, "") for text in (key, dumps(one["value"]), one["unit"] or "")]
        for key, one in values.items()
    ]
    texts, _ = table(_COLUMNS, rows, UNLIMITED)
    lines = [
        f"{found.name}: {found.description}",
        f"robot {robot.name}: {len(robot.joints)} joints, {robot.total_mass:.3g} kg",
        "",
        *(text.plain.rstrip() for text in texts),
    ]
    emit(facts, lines, as_json=json)


def _is_number(value: Any) -> bool:
    every = cast("list[object]", value) if isinstance(value, list) else [value]
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in every)
