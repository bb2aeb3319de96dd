"""One run of a sweep: from a scenario and its changes to a row of results.

A row is a mapping of column to a number, text, or list of one value a joint. The columns ``worker``
and those whose names end in ``_wall`` depend on the machine; all others depend only on what the
run's key is made of.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import tomlkit

from undulog.analysis.common.estimate import Interval
from undulog.analysis.results.analysis import Analysis
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.parts import UNCOMPARED
from undulog.analysis.signals.stretch import Options
from undulog.capture import Session
from undulog.capture.common.config import read
from undulog.capture.common.errors import (
    DescriptionFault,
    PlanError,
    RobotFileError,
    UndulogError,
    UsageError,
)
from undulog.capture.common.strict_table import Faults, StrictTable
from undulog.capture.common.untrusted_text import read_toml
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Robot
from undulog.sim.scenario.scenario import Kernels, Scenario
from undulog.sim.scenario.scenario_file import parse_scenario
from undulog.sim.twin.recording import record

from .rows import Row, RowStore

_PACKAGES = ("numpy", "scipy", "pandas", "pybullet", "mujoco", "numba", "mcap")
_OF_JOINTS = ("command_amplitude_rad", "energy_net_j", "energy_abs_j", "energy_el_j")


@dataclass(frozen=True)
class RobotText:
    """A robot's file and the databases beside it, by name."""

    text: str
    databases: Mapping[str, str]


@dataclass(frozen=True)
class Setting:
    """What all runs of a sweep share.

    Attributes:
        scenario: The scenario's file.
        name: Its file name, for messages.
        robots: The robots that its runs name.
        duration_s: Length of each run [s], or None for the scenario's.
        software: Versions of the code that computes the rows.
        sessions: Address of the store that keeps the sessions, or None.
    """

    scenario: str
    name: str
    robots: Mapping[str, RobotText]
    duration_s: float | None
    kernels: Kernels
    options: Options
    software: Mapping[str, str]
    sessions: str | None = None

    def facts(self) -> dict[str, Any]:
        """Return what determines the rows, as JSON takes it."""
        return {
            "scenario": self.scenario,
            "robots": {name: asdict(robot) for name, robot in sorted(self.robots.items())},
            "duration_s": self.duration_s,
            "kernels": self.kernels.value,
            "options": asdict(self.options),
            "software": dict(self.software),
        }


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        key: Hash of everything that determines its results, 32 hexadecimal digits.
        changes: Key to value, as a plan names them.
    """

    key: str
    changes: dict[str, Any]
    seed: int


@cache
def software() -> dict[str, str]:
    """Return the versions of all code that computes a row, undulog's by its source text."""
    import undulog.capture

    root = Path(undulog.capture.__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for package in ("analysis", "capture", "sim"):
        for path in sorted((root / package).rglob("*")):
            if path.suffix in (".py", ".toml", ".dbc") and path.is_file():
                digest.update(path.relative_to(root).as_posix().encode() + b"\0")
                digest.update(path.read_bytes())
    digest.update(Path(__file__).read_bytes())
    versions = {"python": platform.python_version(), "source": digest.hexdigest()[:32]}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def digest_of(facts: Mapping[str, Any]) -> str:
    """Hash a mapping, 32 hexadecimal digits."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()[:32]


def run_key(setting: str, changes: Mapping[str, Any], seed: int) -> str:
    """Hash everything that determines a run's results.

    Args:
        setting: Digest of the setting's facts.
    """
    return digest_of({"setting": setting, "changes": changes, "seed": seed})


def scenario_of(setting: Setting, changes: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a run, but for its seed.

    Raises:
        UsageError: If its length is impossible.
        ScenarioError: If it has faults; lists all of them.
        RobotFileError: If its robot has faults; lists all of them.
    """
    of_robot = {key.removeprefix("robot."): v for key, v in changes.items() if _of(key, "robot")}
    others = {k: v for k, v in changes.items() if not _of(k, "robot") and not _of(k, "analysis")}
    named = str(others.get("robot", read_toml(setting.scenario).get("robot")))
    robot = None
    if named in setting.robots:
        robot = _changed_robot(named, setting.robots[named], of_robot)
    scenario = parse_scenario(setting.scenario, setting.name, robot, others)
    return scenario.changed(duration_s=setting.duration_s)


def options_of(setting: Setting, changes: Mapping[str, Any]) -> Options:
    """Return how a run is analysed.

    Raises:
        PlanError: If an option is none, or its value isn't valid.
    """
    of_analysis = {k.removeprefix("analysis."): v for k, v in changes.items() if _of(k, "analysis")}
    faults = Faults()
    given = {key: value for key, value in asdict(setting.options).items() if value is not None}
    options = read(StrictTable(given | of_analysis, "analysis", faults), Options)
    if problems := faults.all():
        raise PlanError(setting.name, problems)
    return options


def _of(key: str, part: str) -> bool:
    return key.startswith(f"{part}.")


def _changed_robot(name: str, robot: RobotText, changes: Mapping[str, Any]) -> Robot:
    source = Path(name)
    if not changes:
        return parse_robot(robot.text, source, robot.databases)
    values = tomlkit.parse(robot.text)
    for key, value in changes.items():
        *path, last = key.split(".")
        table: Any = values
        for part in path:
            table = table.setdefault(part, {}) if hasattr(table, "setdefault") else None
        if not hasattr(table, "setdefault"):
            fault = DescriptionFault(
                key, "a part of what is no table", "a key of a table of the robot"
            )
            raise RobotFileError(source, [fault])
        table[last] = value
    return parse_robot(tomlkit.dumps(values), source, robot.databases)


def row_of(job: Job) -> Row:
    """Return the columns of a row that say which run it is."""
    return {
        "key": job.key,
        "seed": job.seed,
        "session": "",
        "changes": json.dumps(job.changes, sort_keys=True),
        **{
            key: value if isinstance(value, bool | int | float | str) else json.dumps(value)
            for key, value in job.changes.items()
        },
    }


def run_job(setting: Setting, job: Job) -> Row:
    """Simulate and analyse one run.

    Returns:
        Its row; of a run that failed, the error.

    Raises:
        UsageError: If the software isn't that of the computer where the sweep was started.
        UndulogError: If its session can't be kept.
    """
    if (here := software()) != setting.software:
        there = setting.software
        names = (name for name in sorted({*here, *there}) if here.get(name) != there.get(name))
        other = [f"{name} {here.get(name)} instead of {there.get(name)}" for name in names]
        raise UsageError(f"worker {_worker()} has other software: {', '.join(other)}")
    start = time.perf_counter()
    row = row_of(job)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{job.key}.mcap"
        try:
            row |= _results(setting, job, path)
            row |= {"status": "done", "error": ""}
        except Exception as error:  # noqa: BLE001 - its row names it, and others go on
            text = f"{type(error).__name__}: {error}"
            if not isinstance(error, UndulogError):
                last = traceback.extract_tb(error.__traceback__)[-1]
                text += f" ({Path(last.filename).name}, line {last.lineno})"
            row |= {"status": "failed", "error": text.replace(f"{folder}/", "")}
        if setting.sessions is not None and path.exists():
            try:
                row["session"] = RowStore(setting.sessions).keep_session(path)
            except UndulogError as error:
                raise UndulogError(str(error)) from error  # this one travels between processes
    return row | {"run_wall": time.perf_counter() - start, "worker": _worker()}


def _worker() -> str:
    return f"{platform.node()}:{os.getpid()}"


def _results(setting: Setting, job: Job, path: Path) -> Row:
    options = options_of(setting, job.changes)
    scenario = scenario_of(setting, job.changes).changed(seed=job.seed)
    recording = record(scenario, path, kernels=setting.kernels)
    with Session.open(path) as session:
        result = measure_session(session, options, without=UNCOMPARED).analysis  # no column
    return {
        "session_id": recording.session_id,
        "robot": scenario.robot.name,
        "joints": len(scenario.robot.joints),
        "duration_s": scenario.duration_s,
        **result_columns(result),
    }


def result_columns(result: Analysis) -> Row:
    """Return the columns of a row that an analysis gives.

    Angles are in rad, energies in J over the window, the distance in m. NAME_low and NAME_high are
    the ends of NAME's 95 % interval. Lists have one value a joint, null where it is not known.
    """
    joints = result.joints
    columns: Row = {
        "verdict": result.session.verdict,
        "answer": result.answer.verdict,
        "sentence": result.answer.sentence,
        "warnings": list(result.warnings),
        "joint": [joint.name for joint in joints],
        **{name: [getattr(joint, name) for joint in joints] for name in _OF_JOINTS},
    }
    columns |= _columns("gain", [(joint.gain.value, joint.gain.ci95) for joint in joints])
    columns |= _columns("lag_rad", [(joint.lag_rad.value, joint.lag_rad.ci95) for joint in joints])
    single = {"frequency_hz": result.gait.frequency_hz, **result.heterogeneity}
    if result.energy is not None:
        transport = result.energy.transport
        single |= {"distance_m": transport.distance_m, "cost_of_transport": transport.abs}
    for name, estimate in single.items():
        cells = _columns(name, [(estimate.value, estimate.ci95)])
        columns |= {column: value for column, (value,) in cells.items()}
    return columns


def _columns(
    name: str, values: Sequence[tuple[float | None, Interval | None]]
) -> dict[str, list[float | None]]:
    """Return values and the ends of their intervals."""
    return {
        name: [value for value, _ in values],
        f"{name}_low": [None if ci95 is None else ci95[0] for _, ci95 in values],
        f"{name}_high": [None if ci95 is None else ci95[1] for _, ci95 in values],
    }
