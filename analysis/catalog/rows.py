"""Rows of a catalogue: sessions, their analyses, and the results of their joints.

Angles are in rad, energies in J, times in s. ``NAME_low`` and ``NAME_high`` are the ends of the
95 % interval of ``NAME``. What was not analysed or can't be computed is null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from undulog.capture.log.read.facts import LogFacts

_ARROW: Any = pa  # comes without types
_NS = 1_000_000_000

Row = dict[str, Any]

INDICES = (
    "gain_cv",
    "lag_sd",
    "boundary_contrast_gain",
    "boundary_contrast_lag",
    "energy_cv",
    "energy_gini",
    "module_share",
)
"""Heterogeneity indices that an analysis row has."""

_JOINT_NUMBERS = (
    "command_amplitude_rad",
    "energy_net_j",
    "energy_plus_j",
    "energy_abs_j",
    "energy_el_j",
    "coverage",
)


def _with_interval(*names: str) -> list[str]:
    return [column for name in names for column in (name, f"{name}_low", f"{name}_high")]


def _schema(**kinds: str) -> Any:
    """Return an Arrow schema; a kind is a type's name with the columns' names."""
    types = {
        "texts": _ARROW.string(),
        "integers": _ARROW.int64(),
        "numbers": _ARROW.float64(),
        "lists": _ARROW.list_(_ARROW.string()),
        "flags": _ARROW.bool_(),
        "times": _ARROW.timestamp("ns"),  # UTC
    }
    return _ARROW.schema(
        [(name, types[kind]) for kind, names in kinds.items() for name in names.split()]
    )


SCHEMAS: Mapping[str, Any] = {
    "sessions": _schema(
        texts="path head session_id robot scenario operator engine verdict software damage "
        "metadata",
        integers="part size modified_ns scanned_ns start_ns end_ns messages seed",
        numbers="duration_s",
        lists="topics",
        flags="removed",
        times="start",
    ),
    "analyses": _schema(
        texts="source session_id answer sentence detail gait_wave changes",
        integers="modified_ns scanned_ns joints joints_compared",
        numbers=" ".join(
            [
                *("start_s", "stop_s", "cycles", "distance_m", "cost_of_transport"),
                *_with_interval("frequency_hz", *INDICES),
            ]
        ),
        lists="warnings not_following stand_out",
        flags="latest removed",
    ),
    "joints": _schema(
        texts="source session_id joint plane",
        integers="modified_ns scanned_ns position",
        numbers=" ".join(
            [
                *("start_s", "stop_s", "cycles", "frequency_hz", *_JOINT_NUMBERS),
                *_with_interval("gain", "lag_rad"),
            ]
        ),
        lists="flags",
        flags="removed",
    ),
}
"""Kind of row to its Arrow schema. ``source`` names the file that a result was read from."""


def table_of(kind: str, rows: Sequence[Row]) -> Any:
    """Return rows of a kind as a ``pyarrow.Table``; columns that a row lacks are null."""
    schema = SCHEMAS[kind]
    columns = [
        _ARROW.array([row.get(field.name) for row in rows], type=field.type) for field in schema
    ]
    return _ARROW.table(columns, schema=schema)


_OF_SESSION = ("session_id", "robot", "scenario", "operator", "engine")


def session_row(facts: LogFacts) -> Row:
    """Return the columns of a session's row that its file gives."""
    own = facts.metadata.get("undulog", {})
    part = facts.metadata.get("undulog.part", {})
    start_ns, end_ns, duration_s = facts.start_ns, facts.end_ns, None
    if start_ns is not None and end_ns is not None:
        duration_s = (end_ns - start_ns) / _NS
        if max(start_ns, end_ns) >= 1 << 63:  # beyond what a time can be
            start_ns = end_ns = None
    return {
        **{name: own.get(name) for name in _OF_SESSION},
        "software": own.get("undulog"),
        "seed": _integer(own.get("seed")),
        "part": _integer(part.get("part")) or 1,
        "verdict": facts.metadata.get("undulog.health", {}).get("verdict"),
        "start_ns": start_ns,
        "end_ns": end_ns,
        "start": start_ns,
        "duration_s": duration_s,
        "messages": facts.messages,
        "topics": list(facts.topics),
        "damage": facts.damage or None,
        "metadata": json.dumps(dict(own), sort_keys=True) if own else None,
    }


def _integer(text: str | None) -> int | None:
    return int(text) if text is not None and text.isascii() and text.isdigit() else None


def is_result(value: Any) -> bool:
    """Return whether a JSON value is what ``undulog analyse`` writes of one session."""
    keys = ("session", "answer", "gait", "joints", "heterogeneity", "warnings")
    return isinstance(value, dict) and all(key in value for key in keys)


def result_rows(result: Mapping[str, Any]) -> tuple[Row, list[Row]]:
    """Return the row of an analysis and the rows of its joints.

    Args:
        result: JSON object of an analysis, as :meth:`.Analysis.to_dict` gives it.

    Raises:
        KeyError, TypeError, ValueError: If it is damaged.
    """
    answer, gait = result["answer"], result["gait"]
    windows = gait["windows"]
    window: Row = {
        "session_id": result["session"]["id"],
        "start_s": windows[0]["start_s"] if windows else None,
        "stop_s": windows[-1]["stop_s"] if windows else None,
        "cycles": sum(one["cycles"] for one in windows) if windows else None,
    }
    analysis = window | {
        "answer": answer["verdict"],
        "sentence": answer["sentence"],
        "detail": answer["detail"],
        "gait_wave": gait["wave"],
        "joints": len(result["joints"]),
        "joints_compared": answer["compared"],
        "warnings": list(result["warnings"]),
        "not_following": [one["joint"] for one in answer["not_following"]],
        "stand_out": [one["joint"] for one in answer["stand_out"]],
        **_estimate("frequency_hz", gait["frequency_hz"], gait["frequency_ci95"]),
    }
    for name in INDICES:
        if (index := result["heterogeneity"].get(name)) is not None:
            analysis |= _estimate(name, index["value"], index["ci95"])
    if result.get("energy") is not None:
        transport = result["energy"]["transport"]
        analysis |= {"distance_m": transport["distance_m"], "cost_of_transport": transport["abs"]}
    return analysis, [
        window
        | {"joint": joint["name"], "plane": joint["plane"], "position": position}
        | {name: joint[name] for name in ("frequency_hz", *_JOINT_NUMBERS)}
        | {"flags": list(joint["flags"])}
        | _estimate("gain", joint["gain"], joint["gain_ci95"])
        | _estimate("lag_rad", joint["lag_rad"], joint["lag_ci95"])
        for position, joint in enumerate(result["joints"])
    ]


def _estimate(name: str, value: float | None, ci95: Sequence[float] | None) -> Row:
    low, high = ci95 or (None, None)
    return {name: value, f"{name}_low": low, f"{name}_high": high}


_SWEPT = ("distance_m", "cost_of_transport", *_with_interval("frequency_hz", *INDICES))


def sweep_rows(row: Mapping[str, Any]) -> tuple[Row, list[Row]] | None:
    """Return the rows of a finished run of ``undulog sweep``; None where it has no results."""
    if row.get("status") != "done" or not row.get("session_id"):
        return None
    names: list[str] = row.get("joint") or []
    analysis: Row = {
        "session_id": row["session_id"],
        "answer": row.get("answer"),
        "sentence": row.get("sentence"),
        "joints": len(names),
        "warnings": row.get("warnings") or [],
        "changes": row.get("changes"),
        **{name: row.get(name) for name in _SWEPT},
    }
    numbers = (*_JOINT_NUMBERS, *_with_interval("gain", "lag_rad"))
    columns = [name for name in numbers if isinstance(row.get(name), list)]
    return analysis, [
        {
            "session_id": row["session_id"],
            "joint": joint,
            "position": position,
            "frequency_hz": row.get("frequency_hz"),
            **{name: row[name][position] for name in columns},
        }
        for position, joint in enumerate(names)
    ]
