"""Commands ``sim list``, ``sim run`` and ``sim show``."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from importlib.util import find_spec
from json import dumps
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from cyclopts import Parameter

from undulog.capture.common.console import (
    UNLIMITED,
    TerminalColumn,
    emit,
    output_width,
    progress,
    refuse_existing,
    table,
)
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import interruptible

if TYPE_CHECKING:
    from ..scenario.scenario import Kernels, Scenario
    from ..twin.recording import TwinRecording
    from ..twin.twin import Sample

_COLUMNS = (
    TerminalColumn("key", left=True),
    TerminalColumn("value", left=True),
    TerminalColumn("unit", left=True),
)
_HEAD = ("name", "description", "robot")

_UNITS = (
    ("s", "*_s"),
    ("Hz", "*_hz"),
    ("V", "*_v"),
    ("rad", "gait.*amplitude gait.*lag gait.*offset gait.*phase gait.*kick_size noise.position"),
    ("rad", "*.heading *.slope *.slope_heading *.inclination *.north sensing.servo.* *.backlash"),
    ("rad", "controller.*.f0 controller.*.largest"),
    ("rad/s", "gait.*.detuning noise.velocity *.stribeck_speed"),
    ("1/s", "gait.*.forward gait.*.backward gait.*.approach_rate gait.*.attraction"),
    ("1/s", "gait.*.feedback"),
    ("1/m", "controller.*.k"),
    ("1/rad", "*.proportional_gain"),
    ("N", "disturbances.force"),
    ("N m", "noise.effort *.stall_torque *.coulomb_friction *.static_friction"),
    ("N m/A", "*.torque_constant"),
    ("N m/rad", "*.gear_stiffness"),
    ("N m s/rad", "*.viscous_friction *.gear_damping"),
    ("kg m^2", "*.rotor_inertia"),
    ("N/m", "world.*.stiffness"),
    ("N s/m", "world.*.damping world.*.drag_tangential world.*.drag_normal"),
    ("m/s", "world.velocity world.*.slip_speed"),
    ("m/s^2", "world.gravity sensing.accelerometer.noise sensing.accelerometer.resolution"),
    ("T", "sensing.compass.noise sensing.compass.resolution sensing.compass.horizontal_field"),
    ("m", "sensing.sonar.noise sensing.sonar.resolution sensing.ir.peak *_m"),
    ("m", "*.position *.radius *.height *.size *.from *.to *.thickness *.centre *.clear *.gap"),
)
_NUMBERS = (  # without a unit
    "*seed *.count *.rays *_bits *.mu *.mu_tangential *.mu_normal *.gain *_gain *.slip_ratio "
    "*.smallest *.mass_factor *.feedback_bias faults.value"
)


def null(
    scenario: str,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    spread: float = 0.2,
    kernels: Literal["numpy", "numba", "auto"] = "auto",
    force: bool = False,
    json: bool = False,
) -> None:
    """Model how identical modules answer a scenario's gait, for `undulog analyse --null`.

    The twin runs the scenario with its servos' stall torque, gain and friction and the ground's
    friction changed by 10 %, singly and by pairs, and with each module changed by itself: about a
    hundred runs for 13 driven joints. The scenario's modules must be identical and its gait steady.

    Example: `undulog sim null weak-servo-pi3 -o weak.null.json`

    Args:
        scenario: Name of a shipped scenario (see `undulog sim list`), or a TOML file.
        output: The model to write, `.json`.
        spread: Relative standard deviation of the shared parameters, as known before a session.
        kernels: What computes the forces: `numba` is faster; `auto` takes it where it is installed.
        force: Replace the output if it is there.
        json: Print one JSON object instead of text.
    """
    from importlib.metadata import version

    from undulog.capture.robot.null_model import write_null_model

    from ..scenario.scenario_file import load_scenario
    from ..twin.null_model import null_model

    if output.suffix.lower() != ".json":
        raise UsageError(f"{output}: a null model is JSON; end its name in .json")
    if not 0 < spread < 1:
        raise UsageError(f"--spread {spread:g}: give a share between 0 and 1")
    chosen = load_scenario(scenario)
    refuse_existing(output, force=force)
    with progress(f"null model of {chosen.name}", 1.0) as bar:
        model = null_model(
            chosen,
            made_by=f"undulog {version('undulog')} sim null {chosen.name} ({chosen.session_id})",
            spread=spread,
            kernels=_kernels(kernels),
            on_run=lambda done, total: bar.update(done / total, f"run {done} of {total}"),
        )
    write_null_model(output, model)
    facts = {
        "path": str(output),
        "robot": model.robot,
        "frequency_hz": model.frequency_hz,
        "joints": list(model.joints),
        "parameters": {parameter.name: parameter.value for parameter in model.parameters},
        "error": model.error,
    }
    driven = f"{len(model.joints)} driven joints of {model.robot} at {model.frequency_hz:g} Hz"
    off = f"off the twin by at most {model.error:.2g} in ln gain and lag within its reach"
    lines = [f"{output}: {driven}; {off}"]
    for parameter in model.parameters:
        value = f"{parameter.name.replace('_', ' ')} {parameter.value:g} {parameter.unit}"
        lines.append(f"{value}, by a factor exp(±{parameter.reach:g})")
    emit(facts, lines, as_json=json)


def list_scenarios(*, json: bool = False) -> None:
    """List the shipped scenarios by robot: name, duration, and what each is about.

    Example: `undulog sim list`

    Args:
        json: Print one JSON array instead of text.
    """
    from ..scenario.scenario_file import load_scenario, scenario_names

    scenarios = [load_scenario(name) for name in scenario_names()]
    described = [_described(scenario) for scenario in scenarios]
    emit(described, _listed(scenarios, output_width()), as_json=json)


def run(
    scenario: str,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    duration: float | None = None,
    seed: int | None = None,
    change: Annotated[list[str] | None, Parameter(name="--set")] = None,
    kernels: Literal["numpy", "numba", "auto"] = "numpy",
    force: bool = False,
    json: bool = False,
) -> int:
    """Simulate a scenario and record it as a session, faster than real time.

    The same scenario, seed and kernels give the same file, byte for byte. SIGINT and SIGTERM end
    the run between two samples and leave a whole file.

    Example: `undulog sim run weak-servo-pi3 -o weak.mcap`

    Args:
        scenario: Name of a shipped scenario (see `undulog sim list`), or a TOML file.
        output: The session file to write, `.mcap`.
        duration: Simulated length in seconds, instead of the scenario's.
        seed: Seed of the sensor noise, instead of the scenario's.
        change: `KEY=VALUE`, a key of the scenario file with dots and its value, e.g.
            `world.slope=0.005` (rad); as often as wanted.
        kernels: What computes the forces: `numba` is faster and rounds otherwise; `auto` takes it
            where it is installed.
        force: Replace the output if it is there.
        json: Print one JSON object instead of text.
    """
    from ..scenario.scenario_file import load_scenario, read_changes
    from ..twin.recording import record

    check_session_name(output)
    chosen = load_scenario(scenario, read_changes(change or [])).changed(
        duration_s=duration, seed=seed
    )
    refuse_existing(output, force=force)
    recording, factor = with_progress(
        chosen.name,
        chosen,
        partial(record, chosen, output, force=force, kernels=_kernels(kernels)),
    )
    facts = _reported(chosen, recording, factor)
    emit(facts, _summary(chosen, recording, factor), as_json=json)
    return 0 if recording.complete else 1


def _kernels(choice: Literal["numpy", "numba", "auto"]) -> Kernels:
    from ..scenario.scenario import Kernels

    if choice == "auto":
        return Kernels.NUMPY if find_spec("numba") is None else Kernels.NUMBA
    return Kernels(choice)


def check_session_name(output: Path) -> None:
    """Check that the name of a session to be written ends in ``.mcap``."""
    if output.suffix != ".mcap":
        raise UsageError(
            f"{output}: sessions are MCAP files; name it {output.with_suffix('.mcap')}"
        )


def speed_text(time_s: float, start: float) -> str:
    """Return the speed of a simulation as text.

    Args:
        time_s: Simulated time [s].
        start: Time of the monotonic clock at its start [s].
    """
    return f"{time_s / max(time.monotonic() - start, 1e-3):.1f} x real time"


def with_progress(
    name: str, scenario: Scenario, run: Callable[..., TwinRecording]
) -> tuple[TwinRecording, float]:
    """Record a run of the twin with a progress bar, until its end or a signal.

    Args:
        run: Records the scenario, given ``stop`` and ``on_sample``.

    Returns:
        The recording and its speed, in multiples of real time.
    """
    start = time.monotonic()
    with interruptible() as stop, progress(name, scenario.duration_s) as bar:

        def show(sample: Sample) -> None:
            bar.update(sample.time_s, speed_text(sample.time_s, start))

        recording = run(stop=stop, on_sample=show)
    return recording, recording.duration_s / (time.monotonic() - start)


def _listed(scenarios: Sequence[Scenario], columns: int) -> list[str]:
    """Lines that list scenarios, by robot, the descriptions wrapped to the terminal."""
    name_width = max(len(scenario.name) for scenario in scenarios)
    by_robot: dict[str, list[Scenario]] = {}
    for scenario in scenarios:
        by_robot.setdefault(scenario.robot.name, []).append(scenario)
    lines = [f"{len(scenarios)} scenarios of {len(by_robot)} robots"]
    for robot, chosen in sorted(by_robot.items(), key=lambda item: -len(item[1])):
        lines += ["", f"{robot}, {len(chosen[0].robot.joints)} joints:"]
        for scenario in chosen:
            start = f"  {scenario.name:{name_width}} {scenario.duration_s:5g} s  "
            wide = max(columns, len(start) + 40)
            indent = " " * len(start)
            lines += wrap(
                scenario.description, wide, initial_indent=start, subsequent_indent=indent
            )
    return lines


def _described(scenario: Scenario) -> dict[str, Any]:
    return {
        "name": scenario.name,
        "robot": scenario.robot.name,
        "joints": len(scenario.robot.joints),
        "duration_s": scenario.duration_s,
        "settle_s": scenario.settle_s,
        "description": scenario.description,
    }


def _closure(recording: TwinRecording) -> float | None:
    """Greater of the two residuals, as a share of the absolute mechanical work."""
    energy = recording.energy
    worst = max(abs(energy["mechanical_residual"]), abs(energy["electrical_residual"]))
    return worst / energy["mechanical_abs"] if energy["mechanical_abs"] > 0 else None


def _reported(scenario: Scenario, recording: TwinRecording, factor: float) -> dict[str, Any]:
    return {
        "path": str(recording.path),
        "session_id": recording.session_id,
        "scenario": scenario.name,
        "robot": scenario.robot.name,
        "seed": scenario.seed,
        "engine": scenario.engine,
        "duration_s": recording.duration_s,
        "planned_duration_s": scenario.duration_s,
        "settle_s": scenario.settle_s,
        "complete": recording.complete,
        "samples": recording.sample_count,
        "energy_j": recording.energy,
        "energy_closure": _closure(recording),
        "obstacle_contact_s": recording.contact_s,
        "real_time_factor": factor,
    }


def _summary(scenario: Scenario, recording: TwinRecording, factor: float) -> list[str]:
    energy, closure = recording.energy, _closure(recording)
    robot = scenario.robot
    if recording.complete:
        first = f"{recording.path}: {recording.duration_s:g} s of {scenario.name}"
    else:
        first = (
            f"stopped at {recording.duration_s:g} s of {scenario.duration_s:g} s; "
            f"{recording.path} is complete up to there"
        )
    who = f"{robot.name}, {recording.sample_count} samples of {len(robot.joints)} joints"
    work = f"mechanical work {energy['mechanical_net']:.3g} J net, {energy['mechanical_abs']:.3g} J"
    electrical = f"electrical {energy['electrical_net']:.3g} J"
    lines = [first, f"{who}, session {recording.session_id}", f"{work} absolute; {electrical}"]
    if closure is not None:
        lines.append(f"energy ledger closes within {100 * closure:.2g} % of the absolute work")
    if scenario.world.obstacles:
        lines.append(_touched(recording.contact_s))
    lines.append(f"simulated with {scenario.engine} at {factor:.1f} x real time")
    return lines


def _touched(contact_s: dict[str, float]) -> str:
    """Describe the links that touched obstacles."""
    if not contact_s:
        return "no link touched an obstacle"
    longest = max(contact_s, key=contact_s.__getitem__)
    links = "link" if len(contact_s) == 1 else "links"
    return (
        f"{len(contact_s)} {links} touched obstacles, {longest} longest: {contact_s[longest]:.3g} s"
    )


def show(scenario: str, /, *, json: bool = False) -> None:
    """Show a scenario: robot, gait, world and sensors, every value with its unit, defaults too.

    The keys are those of the scenario file, and of `undulog sim run --set KEY=VALUE`.

    Example: `undulog sim show weak-servo-pi3`

    Args:
        scenario: Name of a shipped scenario (see `undulog sim list`), or a TOML file.
        json: Print one JSON object: each key with value and unit.
    """
    from undulog.capture.common.untrusted_text import read_toml

    from ..scenario.scenario_file import load_scenario

    chosen = load_scenario(scenario)
    every = dict(leaves(read_toml(chosen.toml())))
    values = {
        key: {"value": value, "unit": unit_of(key) if _is_number(value) else ""}
        for key, value in every.items()
        if key not in _HEAD
    }
    robot = chosen.robot
    facts = {
        "name": chosen.name,
        "description": chosen.description,
        "robot": {"name": robot.name, "joints": len(robot.joints), "mass_kg": robot.total_mass},
        "values": values,
    }
    rows = [
        [(text, "") for text in (key, dumps(value["value"]), value["unit"] or "")]
        for key, value in values.items()
    ]
    texts, _ = table(_COLUMNS, rows, UNLIMITED)
    lines = [
        f"{chosen.name}: {chosen.description}",
        f"robot {robot.name}: {len(robot.joints)} joints, {robot.total_mass:.3g} kg",
        "",
        *(text.plain.rstrip() for text in texts),
    ]
    emit(facts, lines, as_json=json)


def _is_number(value: Any) -> bool:
    every = cast("list[object]", value) if isinstance(value, list) else [value]
    return all(isinstance(entry, int | float) and not isinstance(entry, bool) for entry in every)


def unit_of(key: str) -> str | None:
    """Return the unit of a number of a scenario.

    Args:
        key: With dots, and an index in brackets in a list: ``world.obstacles[2].radius``.

    Returns:
        The unit, in SI; empty for a number without one; None if the key is unknown.
    """
    plain = re.sub(r"\[\d+\]", "", key)
    for unit, patterns in (*_UNITS, ("", _NUMBERS)):
        if any(fnmatchcase(plain, pattern) for pattern in patterns.split()):
            return unit
    return None


def leaves(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of a scenario's tables with its key, in order."""
    for name, value in values.items():
        key = f"{before}{name}"
        if isinstance(value, dict):
            yield from leaves(cast("dict[str, Any]", value), f"{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for k, item in enumerate(cast("list[dict[str, Any]]", value)):
                yield from leaves(item, f"{key}[{k}].")
        else:
            yield key, value
