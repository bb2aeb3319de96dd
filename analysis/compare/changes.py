"""What was changed: where the sessions' own descriptions of themselves differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from undulog.capture import SessionView
from undulog.capture.common.strict_table import read_toml

from ..results.comparison import Change

_OF_THE_RUN = frozenset(
    {
        *("session_id", "epoch_ns", "seed", "scenario", "source_session"),
        *("driven.by", "driven.session_id", "planned_duration_s"),
    }
)
"""Facts that name a run rather than describe how it was made."""

_TEXTS = frozenset({"name", "description", "seed", "epoch_s", "robot"})
"""Keys of an attached file that say nothing of what it does."""

_FILES = ("robot.toml", "scenario.toml", "plan.toml", "calibration.toml")
_ORDER = ("robot", *_FILES, "session")


def facts_of(session: SessionView) -> dict[str, str]:
    """What a session says of how it was made.

    Args:
        session: An open session.

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
    told = session.metadata.get("undulog", {})
    return facts | {
        f"session: {key}": value for key, value in told.items() if key not in _OF_THE_RUN
    }


def changes(a: Sequence[Mapping[str, str]], b: Sequence[Mapping[str, str]]) -> tuple[Change, ...]:
    """Facts whose values on side B are not those on side A.

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
        if (sides := (_told(a, name), _told(b, name)))[0] != sides[1]
    ]
    found.sort(key=lambda one: _ORDER.index(one.name.partition(":")[0]))
    return tuple(found)


def _told(side: Sequence[Mapping[str, str]], name: str) -> str | None:
    values = sorted({facts[name] for facts in side if name in facts})
    return ", ".join(values) if values else None


def _flat(value: Any, before: str = "") -> dict[str, str]:
    """A TOML table by dotted names; entries of a list go by their own name, or their place."""
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
