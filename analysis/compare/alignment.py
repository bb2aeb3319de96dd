"""Whether sessions can be compared, joint by joint: by the same commands, on the same joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.errors import DataError
from undulog.capture.common.strict_table import read_toml

from ..results import formats
from ..results.comparison import Change
from ..session.runs import SAME_COMMAND, GaitRun, command_change, other_frequency

_OF_THE_RUN = frozenset(
    {
        *("session_id", "epoch_ns", "seed", "scenario", "source_session"),
        *("driven.by", "driven.session_id", "planned_duration_s"),
    }
)
"""Facts that name a run rather than describe how it was made."""

_TEXTS = frozenset({"name", "description", "seed", "epoch_s", "robot"})
"""Keys of an attached file without an effect."""

_FILES = ("robot.toml", "scenario.toml", "plan.toml", "calibration.toml")
_ORDER = ("robot", *_FILES, "session")


def facts_of(session: SessionView) -> dict[str, str]:
    """Read the facts that a session records of itself.

    Returns:
        Dotted names to text: of the attached robot, scenario and plan (e.g.
        ``scenario.toml: servo_of.joint03.stall_torque``), and of the metadata.
    """
    facts = {"robot": "" if session.robot is None else session.robot.name}
    for file in _FILES:
        data = session.attachments.get(file)
        if data is None:
            continue
        try:
            table = read_toml(data.decode())
        except ValueError:
            facts[f"{file}: text"] = repr(data)
            continue
        kept = {key: value for key, value in table.items() if key not in _TEXTS}
        facts |= {f"{file}: {key}": text for key, text in _flat(kept).items()}
    recorded = session.metadata.get("undulog", {})
    return facts | {
        f"session: {key}": value for key, value in recorded.items() if key not in _OF_THE_RUN
    }


def changes(a: Sequence[Mapping[str, str]], b: Sequence[Mapping[str, str]]) -> tuple[Change, ...]:
    """List the facts that differ between the sides.

    Args:
        a: Facts of each session of side A.
        b: Of each session of side B.

    Returns:
        Robot first, then scenario, then versions; values that only one side has are None on the
        other.
    """
    names = list(dict.fromkeys(name for facts in (*a, *b) for name in facts))
    found = [
        Change(name, *sides)
        for name in names
        if (sides := (_recorded_value(a, name), _recorded_value(b, name)))[0] != sides[1]
    ]
    return tuple(sorted(found, key=lambda one: _ORDER.index(one.name.partition(":")[0])))


def _recorded_value(side: Sequence[Mapping[str, str]], name: str) -> str | None:
    values = sorted({facts[name] for facts in side if name in facts})
    return ", ".join(values) if values else None


def _flat(value: Any, before: str = "") -> dict[str, str]:
    """Flatten a TOML table to dotted names; entries of a list go by their name or index."""
    parts: dict[str, Any] = {}
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        parts = {f"{before}.{key}" if before else key: one for key, one in table.items()}
    elif isinstance(value, list):
        for k, one in enumerate(cast("list[Any]", value)):
            if isinstance(one, dict):
                name = cast("dict[str, Any]", one).get("name", k)
                parts[f"{before}[{name}]"] = one
    if not parts:
        return {} if value == {} else {before: _text(value)}
    flat: dict[str, str] = {}
    for key, one in parts.items():
        flat |= _flat(one, key)
    return flat


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Alignment:
    """Common joints and gait of the sessions of both sides.

    Attributes:
        names: Joints that can be compared, head to tail.
        left_out: Joints that can't, and why.
        gaits_differ: How the gaits differ, or None.
    """

    names: tuple[str, ...]
    left_out: dict[str, str]
    gaits_differ: str | None


def align(a: Sequence[GaitRun], b: Sequence[GaitRun], *, any_gait: bool = False) -> Alignment:
    """Find the joints that can be compared.

    Args:
        a: Runs of one side, at least one.
        b: Runs of the other, at least one.
        any_gait: Compare the responses although the gaits differ.

    Raises:
        DataError: If a session has no gait, no joint is in all of them, or the gaits differ and
            that is not allowed.
    """
    runs = [*a, *b]
    for run in runs:
        if not run.names:
            raise DataError(f"{run.label} has no gait, so there is no gait phase to align it by")
    _refuse_copies(a, "A")
    _refuse_copies(b, "B")
    joints = list(dict.fromkeys(name for run in runs for name in run.names))
    answered = [
        {name for name, ratio in zip(run.names, run.ratio, strict=True) if np.isfinite(ratio)}
        for run in runs
    ]
    names = tuple(name for name in joints if all(name in known for known in answered))
    if not names:
        raise DataError(
            f"no joint has gain and lag in all sessions: {a[0].label} drives "
            f"{_some(a[0].names)}, {b[0].label} {_some(b[0].names)}"
        )
    left_out = {
        name: "no gain and lag in "
        + ", ".join(r.label for r, known in zip(runs, answered, strict=True) if name not in known)
        for name in joints
        if name not in names
    }
    faults = [fault for run in runs[1:] if (fault := gait_fault(run, runs[0], names)) is not None]
    if faults and not any_gait:
        raise DataError(
            f"the gaits differ, so joints would answer differently anyway: {faults[0]}; record the "
            "same gait, or compare nevertheless with --any-gait"
        )
    return Alignment(names, left_out, faults[0] if faults else None)


def gait_fault(run: GaitRun, model: GaitRun, names: Sequence[str]) -> str | None:
    """Return the difference of a run's gait from the model's.

    Args:
        model: The run that it is held against.
        names: Joints to look at, driven in both.

    Returns:
        The reason, or None within 0.5 % of the frequency and 1 % of every command's amplitude.
    """
    different = other_frequency(run, model)
    if different is not None:
        return f"{run.label} has {different[0]} Hz, {model.label} {different[1]} Hz"
    own, other = (
        np.array([one.command[one.names.index(name)] for name in names]) for one in (run, model)
    )
    groups, others = ([one.group[one.names.index(name)] for name in names] for one in (run, model))
    if groups != others:
        return f"{run.label} has other joints than {model.label} at one frequency"
    change = np.ones_like(own)
    for group in set(groups):
        members = [k for k, one in enumerate(groups) if one == group]
        change[members] = command_change(own[members], other[members])
    deviation = np.abs(change - 1)
    worst = int(np.argmax(deviation))
    if deviation[worst] <= SAME_COMMAND:
        return None
    percent = formats.number(100 * (float(np.abs(change[worst])) - 1), 1)
    degrees = formats.number(float(np.degrees(np.angle(change[worst]))), 1)
    return (
        f"at {names[worst]} the command of {run.label} is {percent} % in amplitude and {degrees} "
        f"degrees in phase off that of {model.label}"
    )


def _refuse_copies(runs: Sequence[GaitRun], side: str) -> None:
    """Raise an error for copies: two copies of one run would show no scatter."""
    seen: dict[bytes, str] = {}
    for run in runs:
        numbers = run.ratio.tobytes()
        if numbers in seen:
            raise DataError(
                f"{run.label} is a copy of the numbers of {seen[numbers]} on side {side}: a copy "
                "is not a run of its own"
            )
        seen[numbers] = run.label


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
