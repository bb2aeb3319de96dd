"""A calibration in words, and as one JSON object.

A calibration as files: the robot with its fitted servo, the scenario with the fitted ground.

A robot description is what all modules are meant to be: a module that differs goes into the
scenario's ``servo_of``, the ground is the scenario's, too.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import tomlkit

from undulog.capture.common.console import plain
from undulog.capture.common.errors import DataError
from undulog.capture.common.files import part_file, write_text
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Robot
from undulog.sim.scenario.scenario import Modules

from .fit import Calibration, Fitted
from .identifiability import Alternative
from .lack_of_fit import LEVEL, LackOfFit, Misfit
from .parameters import DELAY


def robot_text(calibration: Calibration) -> str:
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
    factor = {one.module: one.value for one in calibration.parameters if one.module is not None}
    first = robot.joints[0]
    shared = dataclasses.replace(
        first.servo, stall_torque=first.servo.stall_torque / factor.get(first.name, 1.0)
    )
    for key, value in vars(shared).items():
        if servo.get(key) != value:  # what was not fitted stays as it was written
            servo[key] = value
    head = [f"# {robot.name}, its servo fitted to {plain(Path(calibration.session).name)}."]
    if calibration.lack.found:
        head.append("# The twin does not fit that session: what follows has no interval.")
    for one in calibration.parameters:
        unit = "" if one.unit == "1" else f" {one.unit}"
        known = "" if one.determined else "; not determined by this session"
        within = "" if one.ci95 is None else f", 95 % {one.ci95[0]:.4g} to {one.ci95[1]:.4g}"
        head.append(f"# {one.label}: {one.value:.4g}{unit}{within}{known}")
    text = "\n".join([*head, "", tomlkit.dumps(values)])
    parse_robot(text, "fitted robot", dict(robot.databases))  # it can be read back
    return text


def scenario_text(calibration: Calibration, robot_file: Path, scenario_file: Path) -> str:
    """The scenario in which the session can be run again.

    Args:
        robot_file: Where the robot description is.
        scenario_file: Where the scenario will be.
    """
    scenario = calibration.scenario
    modules = {one.module for one in calibration.parameters}
    fitted = [joint for joint in scenario.robot.joints if joint.name in modules]
    own = {joint.name: {"stall_torque": joint.servo.stall_torque} for joint in fitted}
    return dataclasses.replace(
        scenario,
        robot_name=os.path.relpath(robot_file, scenario_file.parent),
        modules=Modules({}, own, scenario.modules.link_of),
    ).toml()


def write_calibration(
    calibration: Calibration, robot_file: Path, scenario_file: Path | None
) -> None:
    """Write the robot, and what its description lists, and the scenario if it is wanted.

    Args:
        scenario_file: The scenario, or None.

    Raises:
        DataError: If the robot has no description.
        LogWriteError: If a file can't be written.
    """
    texts = {robot_file: robot_text(calibration)}
    if scenario_file is not None:
        texts[scenario_file] = scenario_text(calibration, robot_file, scenario_file)
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


NOT_NOISE = 3.0
"""An autocorrelation time of the residual from which it is called out [samples]."""


def summary_lines(calibration: Calibration) -> Iterator[str]:
    """Lines for a terminal.

    Yields:
        The answer first, joints last.
    """
    before, after = (_rms(one) for one in (calibration.before, calibration.after))
    if calibration.lack.found:
        yield from _lack(calibration.lack)
    yield (
        f"{calibration.session} in {calibration.world}: twin and robot are {before:.3g} rad apart "
        f"(RMS) before, {after:.3g} rad after; {calibration.iterations} iterations, "
        f"{calibration.runs} runs at {calibration.speed:.1f} x real time"
    )
    if not calibration.converged:
        yield "The fit did not come to an end: take its numbers as a step on the way."
    fits = not calibration.lack.found
    yield "Parameters (95 % interval; before):" if fits else "Parameters (no interval; before):"
    width = max(len(one.label) for one in calibration.parameters)
    yield from (f"  {_parameter(one, width)}" for one in calibration.parameters)
    if fits:
        yield from _undetermined(calibration)
    yield from _search(calibration)
    yield from _checked(calibration.lack)
    if calibration.memory > NOT_NOISE:
        yield (
            f"What is left has a memory of {calibration.memory:.0f} samples: it isn't the noise of "
            "encoders alone."
        )
    yield "Joints (before -> after):"
    for joint, first in calibration.before.items():
        yield f"  {joint}  {_misfit(first, calibration.after[joint])}"


def reported(calibration: Calibration) -> dict[str, Any]:
    """The calibration as plain JSON values.

    Returns:
        SI units; ``within`` of intervals as pairs.
    """
    search, lack = calibration.search, calibration.lack
    return {
        "session": calibration.session,
        "world": calibration.world,
        "parameters": [
            {key: value for key, value in vars(one).items() if key != "label"}
            for one in calibration.parameters
        ],
        "undetermined": [one.label for one in calibration.parameters if not one.determined],
        "ridges": [vars(one) for one in calibration.ridges],
        "would_tell": list(calibration.would_tell),
        "search": None
        if search is None
        else {**vars(search), "named": search.named and not lack.found},
        "misfit": {
            joint: {"before": vars(first), "after": vars(calibration.after[joint])}
            for joint, first in calibration.before.items()
        },
        "fits": not lack.found,
        "lack_of_fit": {
            "p": lack.p,
            "worst": lack.worst,
            "gait_hz": lack.gait_hz,
            "joints": {joint: vars(one) for joint, one in lack.joints.items()},
            "alternatives": [
                {"label": one.label, "size": one.size, "ci95": one.ci95, "p": one.p}
                for one in lack.alternatives
            ],
            "unfitted": None if lack.unfitted is None else vars(lack.unfitted),
        },
        "rms_rad": {"before": _rms(calibration.before), "after": _rms(calibration.after)},
        "residual_memory_samples": calibration.memory,
        "iterations": calibration.iterations,
        "converged": calibration.converged,
        "runs": calibration.runs,
        "real_time_factor": calibration.speed,
    }


def _lack(lack: LackOfFit) -> Iterator[str]:
    """The first line of a fit that doesn't fit."""
    parts: list[str] = []
    if lack.alternatives:
        best = min(lack.alternatives, key=lambda one: one.p)
        if sum(one.widens is best.widens for one in lack.alternatives) * best.p < LEVEL:
            parts.append(f"{best.label} would fit better ({_size(best)})")
    if off := [j for j, one in lack.joints.items() if len(lack.joints) * one.p < LEVEL]:
        periodic = lack.joints[lack.worst].periodic_rad
        size = "" if periodic is None else f" by {periodic:.2g} rad (RMS)"
        how = "is no noise" if periodic is None else "comes back with every cycle"
        others = f" and {len(off) - 1} more" if len(off) > 1 else ""
        parts.append(f"what is left at {lack.worst}{others} {how}{size}")
    if lack.unfitted is not None and lack.unfitted.p < LEVEL:
        parts.append(
            "the two halves of the session ask for different parameters "
            f"({lack.unfitted.unfitted_rad:.3g} rad off where not fitted, "
            f"{lack.unfitted.fitted_rad:.3g} where fitted)"
        )
    why = "; ".join(parts) or "its joints and halves together leave more than noise"
    yield (
        f"The twin doesn't fit this session ({_p(lack.p)}): {why}. It lacks something that the "
        "robot has: another friction law, play, a weak module (--modules). The values are those "
        "that fit best; they have no intervals, and none is determined."
    )


def _size(other: Alternative) -> str:
    """How much of another law, with its 95 % interval."""
    low, high = other.ci95
    if other.widens:
        return f"weight {other.size:.2f} [{low:.2f}, {high:.2f}], 0 is the twin's law"
    return f"{other.size:.2g} rad [{low:.2g}, {high:.2g}]"


def _checked(lack: LackOfFit) -> Iterator[str]:
    if lack.found:
        return
    what = "the gait's harmonics" if lack.gait_hz is not None else "the residual's memory"
    off = ""
    if lack.unfitted is not None:
        size = lack.unfitted.unfitted_rad
        off = f"; each half under the parameters of the other is {size:.3g} rad off"
    if open_laws := [one.label for one in lack.alternatives if one.widens and one.could_be]:
        yield (
            f"Not determined by this session: {' or '.join(open_laws)} would do as well; "
            "intervals have it in them."
        )
    yield f"Fits: nothing but noise is shown at {what} ({_p(lack.p)}){off}."


def _p(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _rms(misfits: dict[str, Misfit]) -> float:
    return float(np.sqrt(np.mean([one.rms**2 for one in misfits.values()])))


def _parameter(one: Fitted, width: int) -> str:
    scale, unit = (1e3, "ms") if one.name == DELAY else (1.0, "" if one.unit == "1" else one.unit)
    numbers = f"{scale * one.value:.4g}"
    if one.ci95 is not None:
        low, high = one.ci95
        numbers += f" [{scale * low:.4g}, {scale * high:.4g}]"
    before = "" if one.name == DELAY else f"; {scale * one.start:.4g}"
    open_ = "" if one.determined or one.ci95 is None else ", undetermined"
    return f"{one.label:{width}}  {numbers} {unit}".rstrip() + before + open_


def _undetermined(calibration: Calibration) -> Iterator[str]:
    open_ones = [one.label for one in calibration.parameters if not one.determined]
    if not open_ones:
        return
    yield f"Undetermined by this session: {', '.join(open_ones)}."
    for ridge in calibration.ridges:
        parts = (
            f"{label} + {1e3 * factor:.2g} ms" if label == DELAY else f"{label} x {factor:.2f}"
            for label, factor in ridge.factors.items()
        )
        yield f"  answers alike: {', '.join(parts)}"
    yield from (f"  what would determine {line}" for line in calibration.would_tell)


def _search(calibration: Calibration) -> Iterator[str]:
    if (search := calibration.search) is None:
        return
    p = _p(search.p)
    if search.named and calibration.lack.found:
        yield (
            f"Of {search.tried} modules {search.module} lessens the misfit most; whether it "
            "differs is open, since the twin doesn't fit."
        )
    elif search.named:
        yield f"Of {search.tried} modules {search.module} differs ({p}, family-wise)."
    else:
        yield (
            f"Of {search.tried} modules none is shown to differ; {search.module} would be the "
            f"first ({p}, family-wise)."
        )


def _misfit(first: Misfit, last: Misfit) -> str:
    text = f"{first.rms:.4f} -> {last.rms:.4f} rad"
    if first.gain is None or last.gain is None or first.late_s is None or last.late_s is None:
        return text
    return (
        f"{text}; gain {100 * first.gain:+.1f} -> {100 * last.gain:+.1f} %; late "
        f"{1e3 * first.late_s:+.1f} -> {1e3 * last.late_s:+.1f} ms"
    )
