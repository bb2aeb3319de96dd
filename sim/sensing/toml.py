"""The ``[noise]`` and ``[sensing]`` tables of a scenario."""

from __future__ import annotations

import dataclasses

from capture.robot import Robot
from capture.strict_table import Table

from .model import Noise, SensorModels, ServoPolling


def read_noise(table: Table) -> Noise:
    """Read ``[noise]``.

    Args:
        table: The table.

    Returns:
        Standard deviations, 0 where nothing is given.
    """
    names = [item.name for item in dataclasses.fields(Noise)]
    noise = Noise(**{name: table.number(name, default=0.0, at_least=0.0) for name in names})
    table.close()
    return noise


def read_sensing(table: Table, robot: Robot | None, period_s: float) -> SensorModels:
    """Read ``[sensing]``.

    Args:
        table: The table.
        robot: Whose sensors they are, None after a fault.
        period_s: Control period [s].

    Returns:
        The models, with defaults where nothing is given.
    """
    servo = _servo(table.table("servo"), robot, period_s)
    table.close()
    return SensorModels(servo)


def _servo(table: Table, robot: Robot | None, period_s: float) -> ServoPolling:
    def step(key: str) -> float:
        return table.number(key, default=0.0, at_least=0.0)

    servo = ServoPolling(
        slot_s=step("slot_s"),
        resolution=step("resolution"),
        dead_band=step("dead_band"),
        command_resolution=step("command_resolution"),
    )
    if robot is not None and servo.slot_s * len(robot.joints) >= period_s:
        longest = f"{len(robot.joints)} joints' turns in a control period of {period_s:g} s"
        table.fault("slot_s", f"less than {period_s / len(robot.joints):g}, for {longest}")
    table.close()
    return servo
