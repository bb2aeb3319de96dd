"""A calibration as files: the robot with its fitted servo, the scenario with the fitted ground.

A robot description is what all modules are meant to be, so a module that differs goes into the
scenario's ``servo_of``, as the ground does.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import tomlkit

from undulog.capture.common.console import plain
from undulog.capture.common.errors import DataError
from undulog.capture.common.files import part_file, write_text
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Robot
from undulog.sim.scenario.scenario import Modules

from .fit import CalibrationResult


def _robot_text(calibration: CalibrationResult) -> str:
    """The robot description with the fitted servo.

    Returns:
        TOML: the former description, its comments kept, under a header with the fitted parameters.

    Raises:
        DataError: If the scenario's robot has no description.
    """
    robot = calibration.scenario.robot
    if not robot.toml:
        raise DataError(f"{robot.name} has no description to put a servo into")
    values = cast("dict[str, Any]", tomlkit.parse(robot.toml))
    for joint in cast("list[dict[str, Any]]", values.get("joints", [])):
        joint.pop("servo", None)
    defaults = cast("dict[str, Any]", values.setdefault("defaults", {}))
    servo = cast("dict[str, Any]", defaults.setdefault("servo", {}))
    # Of a joint that keeps to what all share; a module's own factor is taken out again.
    factor = {
        parameter.module: parameter.value
        for parameter in calibration.parameters
        if parameter.module is not None
    }
    first = robot.joints[0]
    shared = replace(
        first.servo, stall_torque=first.servo.stall_torque / factor.get(first.name, 1.0)
    )
    for key, value in vars(shared).items():
        if servo.get(key) != value:  # what was not fitted stays as it was written
            servo[key] = value
    names = ", ".join(plain(Path(session).name) for session in calibration.sessions)
    head = [f"# {robot.name}, its servo fitted to {names}."]
    if calibration.lack.significant:
        head.append("# The twin does not fit that session: what follows has no interval.")
    for parameter in calibration.parameters:
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        remark = "" if parameter.determined else "; not determined by this session"
        within = (
            ""
            if parameter.ci95 is None
            else f", 95 % {parameter.ci95[0]:.4g} to {parameter.ci95[1]:.4g}"
        )
        head.append(f"# {parameter.label}: {parameter.value:.4g}{unit}{within}{remark}")
    text = "\n".join([*head, "", tomlkit.dumps(values)])
    parse_robot(text, "fitted robot", dict(robot.databases))  # it can be read back
    return text


def _scenario_text(calibration: CalibrationResult, robot_file: Path, scenario_file: Path) -> str:
    """The scenario in which the session can be run again.

    Args:
        robot_file: Where the robot description is.
        scenario_file: Where the scenario will be.
    """
    scenario = calibration.scenario
    modules = {parameter.module for parameter in calibration.parameters}
    fitted = [joint for joint in scenario.robot.joints if joint.name in modules]
    servo_of = {joint.name: {"stall_torque": joint.servo.stall_torque} for joint in fitted}
    return replace(
        scenario,
        robot_name=os.path.relpath(robot_file, scenario_file.parent),
        modules=Modules({}, servo_of, scenario.modules.link_of),
    ).toml()


def write_calibration(
    calibration: CalibrationResult, robot_file: Path, scenario_file: Path | None
) -> None:
    """Write the robot, and what its description lists, and the scenario if it is wanted.

    Args:
        scenario_file: The scenario, or None.

    Raises:
        DataError: If the robot has no description.
        LogWriteError: If a file can't be written.
    """
    texts = {robot_file: _robot_text(calibration)}
    if scenario_file is not None:
        texts[scenario_file] = _scenario_text(calibration, robot_file, scenario_file)
    for path, text in texts.items():
        write_text(path, text)
    _write_listed(calibration.scenario.robot, robot_file.parent)


def _write_listed(robot: Robot, folder: Path) -> None:
    """The DBC files and meshes that a description lists lie beside it; those there are left."""
    databases = {name: text.encode() for name, text in robot.databases}
    for name, content in (databases | dict(robot.meshes)).items():
        path = folder / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with part_file(path) as part:
                part.write_bytes(content)
