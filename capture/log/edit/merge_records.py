"""What explains merged logs: metadata and attachments, the same once, the different apart.

The records that have a meaning here are merged by it: ``undulog`` keeps the facts that all logs
agree on (each log's own are then in ``undulog.source.N``), ``undulog.health`` the worst verdict.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import cast

from .edit import EDIT_RECORD, HEALTH_RECORD, EditedLog, earlier_edit_name, free_name
from .raw_log import RawLog

Record = tuple[str, dict[str, str]]

_VERDICTS = ("good", "degraded", "bad")
_SESSION_RECORD = "undulog"


def copy_records(
    sources: Sequence[RawLog], log: EditedLog, robot: str, warnings: list[str]
) -> list[Record]:
    """Copy metadata and attachments.

    Args:
        sources: The logs.
        log: The new log.
        robot: The robot that the merged session is of; empty where no log says one.
        warnings: Takes one sentence for each thing that had to be renamed.

    Returns:
        The records to be written at the end, with name and entries.
    """
    # The records of the robot that the session is of come first: they keep their names.
    ordered = sorted(sources, key=lambda source: bool(robot) and source.robot != robot)
    records, health = _merged_metadata(sources, robot, warnings)
    for name, entries in records:
        log.note(name, entries)
    known: dict[str, list[bytes]] = {}
    for source in ordered:
        for attachment in source.attachments:
            if attachment.data in known.get(attachment.name, []):
                continue
            name = free_name(attachment.name, known, "{stem}-{n}{suffix}")
            if name != attachment.name:
                warnings.append(
                    f"{attachment.name} of {source.path} differs from another one: kept as {name}"
                )
            known.setdefault(attachment.name, []).append(attachment.data)
            known.setdefault(name, [attachment.data])
            log.attach(attachment, name)
    return health


def _merged_metadata(
    sources: Sequence[RawLog], robot: str, warnings: list[str]
) -> tuple[list[Record], list[Record]]:
    sessions = [source.file.metadata.get(_SESSION_RECORD) for source in sources]
    first: list[Record] = []
    if any(sessions):
        first.append((_SESSION_RECORD, _merged_session(sources, robot)))
    if len({json.dumps(facts, sort_keys=True) for facts in sessions if facts}) > 1:
        first += [(f"undulog.source.{k + 1}", facts) for k, facts in enumerate(sessions) if facts]
    kept: dict[str, list[dict[str, str]]] = {}
    taken = {name for name, _ in first} | {EDIT_RECORD}
    for source in sources:
        for record in source.metadata:
            is_edit = record.name == EDIT_RECORD or record.name.startswith(f"{EDIT_RECORD}.")
            base = EDIT_RECORD if is_edit else record.name
            if base in (_SESSION_RECORD, HEALTH_RECORD) or record.metadata in kept.get(base, []):
                continue
            name = earlier_edit_name(taken) if is_edit else free_name(base, taken, "{name}.{n}")
            if name != base and not is_edit:
                warnings.append(
                    f"metadata {base} of {source.path} differs from another one: kept as {name}"
                )
            taken.add(name)
            kept.setdefault(base, []).append(record.metadata)
            first.append((name, record.metadata))
    health = _merged_health(sources)
    return first, [(HEALTH_RECORD, health)] if health else []


def _merged_session(sources: Sequence[RawLog], robot: str) -> dict[str, str]:
    """The facts that the logs agree on; an id of their own where they are of several sessions."""
    stated = [facts for s in sources if (facts := s.file.metadata.get(_SESSION_RECORD))]
    every = {key: [f[key] for f in stated if key in f] for f in stated for key in f}
    facts = {key: values[0] for key, values in every.items() if len(set(values)) == 1}
    if "session_id" not in facts:
        digests = "".join(source.sha256 for source in sources)
        facts["session_id"] = f"merge-{hashlib.sha256(digests.encode()).hexdigest()[:16]}"
    epochs = [int(value) for value in every.get("epoch_ns", []) if value.isdecimal()]
    if epochs:
        facts["epoch_ns"] = str(min(epochs))
    facts["robot"] = robot
    return facts


def _merged_health(sources: Sequence[RawLog]) -> dict[str, str]:
    """The worst verdict, and everybody's reasons."""
    stated = {
        source: facts for source in sources if (facts := source.file.metadata.get(HEALTH_RECORD))
    }
    if not stated:
        return {}
    facts = list(stated.values())
    if len(stated) == len(sources) and all(other == facts[0] for other in facts):
        return facts[0]
    verdicts = [entry.get("verdict", "") for entry in facts]
    worst = max(verdicts, key=lambda v: _VERDICTS.index(v) if v in _VERDICTS else len(_VERDICTS))
    reasons = [
        f"{source.path.name}: {reason}"
        for source in sources
        for reason in _reasons(stated.get(source))
    ]
    return {"verdict": worst, "reasons": json.dumps(reasons)}


def _reasons(health: dict[str, str] | None) -> list[str]:
    if health is None:
        return ["states no verdict"]
    text = health.get("reasons", "[]")
    try:
        reasons: object = json.loads(text)
    except (ValueError, RecursionError):
        reasons = [text]
    listed = cast("list[object]", reasons) if isinstance(reasons, list) else [reasons]
    return [health.get("verdict", "no verdict"), *map(str, listed)]
