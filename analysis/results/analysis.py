"""Results of an analysis: frozen values at the border between estimators and readers of results.

``Analysis.to_dict`` is the object that ``undulog analyse --json`` prints and that a result file
holds. A value that could not be computed is None (null), and ``Analysis.warnings`` or
``Analysis.notes`` says why.
Angles are in rad, energies in J over the analysed windows, times in s from the session's start.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

from ..common.answer import Answer
from ..common.estimate import Estimate, PresentedResult, Provenance
from ..parts.artefacts.result import Artefact
from ..parts.body.result import BodyPoint, BodyResult, BodyShape
from ..parts.energy.result import EnergyResult
from ..parts.free_motion.result import FreeMotion
from ..parts.frequency_response.result import JointFrequencyResponse
from ..parts.gait.result import GaitFacts
from ..parts.gaits.result import GaitWindow
from ..parts.ground_contact.result import GroundContact
from ..parts.heterogeneity.result import Index
from ..parts.joints.result import JointResult
from ..parts.oscillators.result import ChainCoupling
from ..parts.over_time.result import ResponseOverTime
from ..parts.tracking.result import JointTracking
from .coupling import Coupling

if TYPE_CHECKING:
    from collections.abc import Sequence

KEYS_OF_THEIR_OWN = {"json": "keys of their own"}
"""Marks a field whose values stand beside the others in the JSON, under keys of their own."""


@dataclass(frozen=True)
class SessionFacts:
    """Which session it was.

    Attributes:
        id: Session id, or the file's name where it has none.
        path: The file, as named by the user.
        robot: Robot name, or None.
        start_ns: Unix time of the first sample [ns].
        duration_s: [s].
        verdict: The recorder's health verdict, or None.
    """

    id: str
    path: str
    robot: str | None
    start_ns: int
    duration_s: float
    verdict: str | None


@dataclass(frozen=True, kw_only=True, repr=False)
class Analysis(PresentedResult):
    """All numbers of one session.

    Example::

        result = undulog.analyse("run.mcap")
        lags_rad = {joint.name: joint.lag_rad.value for joint in result.joints}

    Attributes:
        joints: In chain order, head to tail.
        gaits: Where the gait changes, each with its window; the longest is that of ``gait`` and
            ``joints``.
        body: Head, middle and tail; None with a note where it is unknown.
        body_shape: Principal modes, the nearest serpenoid and the travel of a cycle; None where
            nothing moves periodically.
        ground_contact: Which links are on the ground, from the joints' torques; None where effort
            and current, the head's orientation or the robot description are missing.
        coupling: Identifiable or not.
        warnings: One sentence each, worst first: what is missing or doubtful, and changes what a
            reader does.
        artefacts: What is wrong with samples or at a limit, anywhere in the session, and when.
        over_time: Gain and lag cycle by cycle, by the logged phase; None with a note.
        energy: Energies cycle by cycle, cost of transport, closure.
        oscillators: Couplings of the oscillators that drove it, one a plane; none where no
            oscillator's phase was logged.
        frequency_response: Of joints whose commands are no gait but excite a band or several
            frequencies.
        tracking: How joints follow commands that are no gait: gain, lag and offset.
        closed_loop: What makes the commands of a frequency response depend on measured motion, as
            far as the log shows it, or None.
        free_motion: Where no commands were logged: amplitudes, lags and waves of the motion.
        answer: Which joints do not follow or stand out, and the shape of the rest, in words.
        notes: One sentence each: what was not recorded, does not apply or was assumed.
        more: Results of parts that other packages add, by name: dataclasses, each under a key of
            its own in the JSON; plain values of parts that aren't installed.
    """

    answer: Answer = field(default_factory=Answer)
    session: SessionFacts
    gait: GaitFacts
    joints: tuple[JointResult, ...]
    body: BodyResult | None
    heterogeneity: dict[str, Index]
    coupling: Coupling
    gaits: tuple[GaitWindow, ...] = ()
    body_shape: BodyShape | None = None
    ground_contact: GroundContact | None = None
    over_time: ResponseOverTime | None = None
    energy: EnergyResult | None = None
    oscillators: tuple[ChainCoupling, ...] = ()
    frequency_response: tuple[JointFrequencyResponse, ...] = ()
    tracking: tuple[JointTracking, ...] = ()
    closed_loop: str | None = None
    free_motion: FreeMotion | None = None
    artefacts: tuple[Artefact, ...] = ()
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    provenance: Provenance
    more: dict[str, Any] = field(default_factory=dict[str, Any], metadata=KEYS_OF_THEIR_OWN)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain JSON values.

        An estimate becomes two keys, e.g. ``gain`` and ``gain_ci95``; ``lag_rad`` has its
        interval in ``lag_ci95``.
        """
        values = dataclasses.asdict(self)
        del values["more"]
        return values | {
            "gait": _record(self.gait) | {"groups": [_record(group) for group in self.gait.groups]},
            "joints": [_record(joint) for joint in self.joints],
            "gaits": [
                _record(gait) | {"joints": [_record(joint) for joint in gait.joints]}
                for gait in self.gaits
            ],
            "body": None if self.body is None else _body_dict(self.body),
            "body_shape": None if self.body_shape is None else _shape_dict(self.body_shape),
            "ground_contact": None
            if self.ground_contact is None
            else _contact_dict(self.ground_contact),
            "energy": None if self.energy is None else _energy_dict(self.energy),
            "frequency_response": [_record(response) for response in self.frequency_response],
            "tracking": [_record(joint) for joint in self.tracking],
            "free_motion": None if self.free_motion is None else _motion_dict(self.free_motion),
            "artefacts": [
                dataclasses.asdict(artefact) | {"about": artefact.about}
                for artefact in self.artefacts
            ],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            **{name: plain_result(result) for name, result in self.more.items()},
        }


def plain_result(result: Any) -> Any:
    """Return a result of nested dataclasses as plain JSON values, each estimate as two keys."""
    if dataclasses.is_dataclass(result):
        values = {entry.name: getattr(result, entry.name) for entry in dataclasses.fields(result)}
        return {key: plain_result(value) for key, value in values.items()} | _estimates(result)
    if isinstance(result, (tuple, list)):
        return [plain_result(value) for value in cast("Sequence[Any]", result)]
    if isinstance(result, dict):
        return {key: plain_result(value) for key, value in cast("dict[str, Any]", result).items()}
    return result


def interval_key(key: str) -> str:
    """Name of an estimate's interval in the JSON object of a session.

    Args:
        key: Name of the estimate, e.g. ``lag_rad``.

    Returns:
        For example ``lag_ci95``.
    """
    with_unit = {"lag_rad", "frequency_hz", "phase_rad", "amplitude_m", "distance_m"}
    with_unit |= {"amplitude_rad", "offset_rad"}
    return f"{key.rsplit('_', 1)[0] if key in with_unit else key}_ci95"


def _estimates(record: Any) -> dict[str, Any]:
    """Return each estimate of a record as two keys: its value and its interval."""
    flat: dict[str, Any] = {}
    for attribute in dataclasses.fields(record):
        value, key = getattr(record, attribute.name), attribute.name
        if isinstance(value, Estimate):
            flat |= {key: value.value, interval_key(key): value.ci95}
    return flat


def _record(record: Any) -> dict[str, Any]:
    return dataclasses.asdict(record) | _estimates(record)


def _energy_dict(energy: EnergyResult) -> dict[str, Any]:
    cost = energy.transport
    transport = {"mass_kg": cost.mass_kg, "why": cost.why} | _estimates(cost)
    return dataclasses.asdict(energy) | {"transport": transport}


def _motion_dict(motion: FreeMotion) -> dict[str, Any]:
    waves = [
        _record(wave)
        | {"direction": wave.direction, "local": [_record(part) for part in wave.local]}
        for wave in motion.waves
    ]
    return {"joints": [_record(joint) for joint in motion.joints], "waves": waves}


def _shape_dict(shape: BodyShape) -> dict[str, Any]:
    planes = [
        dataclasses.asdict(plane)
        | {"modes": [_record(mode) for mode in plane.modes], "serpenoid": _record(plane.serpenoid)}
        for plane in shape.planes
    ]
    return {"planes": planes, "travel": None if shape.travel is None else _record(shape.travel)}


def _contact_dict(contact: GroundContact) -> dict[str, Any]:
    return dataclasses.asdict(contact) | {"links": [_record(link) for link in contact.links]}


def _body_dict(body: BodyResult) -> dict[str, Any]:
    def points(some: tuple[BodyPoint, ...]) -> list[dict[str, Any]]:
        return [{"place": point.place, "link": point.link} | _estimates(point) for point in some]

    null = {name: points(some) for name, some in body.null.items()}
    return {"plane": body.plane, "observed": points(body.observed), "null": null}
