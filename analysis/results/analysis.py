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

from .answer import Answer, Artefact, DeadBand
from .body import BodyPoint, BodyResult, BodyShape, GroundContact
from .coupling import Coupling
from .cycles import EnergyResult, ResponseOverTime
from .estimate import Estimate, PresentedResult, Provenance, WithInterval
from .frequency_response import FreeMotion, JointFrequencyResponse, JointTracking

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .oscillators import ChainCoupling

KEYS_OF_THEIR_OWN = {"json": "keys of their own"}
"""Marks a field whose values stand beside the others in the JSON, under keys of their own."""


@dataclass(frozen=True)
class Window:
    """A half-open stretch of the session that was analysed.

    Attributes:
        start_s: From the session's start [s].
        stop_s: From the session's start [s].
        cycles: Gait cycles in it; 0 where there is no gait.
    """

    start_s: float
    stop_s: float
    cycles: float


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


@dataclass(frozen=True)
class GroupFacts:
    """Joints that share a rhythm.

    Attributes:
        joints: Names of the driven joints that have it, head to tail.
        windows: Whole cycles of it at the end of the fitted stretch.
        wave: As in :class:`GaitFacts`.
        lag_per_joint_rad: As in :class:`GaitFacts`.
        trend: How the responses change over the fitted window: ``steady``, ``drifting`` or
            ``settling``; None where it is unknown.
        time_constant_s: Of the approach to steady values, where the responses settle.
        oscillation_hz: Frequency by which a transient that rings is off the gait's; None of others.
        cycle_correlation: Of gain or lag from one cycle to the next, the larger; None where cycles
            do not vary by more than noise.
        effective_cycles: How many independent cycles would show the mean as well, where they vary;
            below 4 intervals may be too narrow.
        frequency_drift_hz_per_s: Of the commands; empty where their frequency stays.
        amplitude_drift_per_cycle: Of the commands, relative; empty where it stays.
    """

    frequency_hz: Estimate
    joints: tuple[str, ...]
    windows: tuple[Window, ...] = ()
    wave: str | None = None
    lag_per_joint_rad: dict[str, float] = field(default_factory=dict[str, float])
    trend: str | None = None
    time_constant_s: Estimate = field(default_factory=Estimate)
    oscillation_hz: float | None = None
    cycle_correlation: float | None = None
    effective_cycles: float | None = None
    frequency_drift_hz_per_s: Estimate = field(default_factory=Estimate)
    amplitude_drift_per_cycle: Estimate = field(default_factory=Estimate)


@dataclass(frozen=True)
class GaitFacts:
    """The rhythm that was found; where joints have several, that of the largest group.

    Attributes:
        frequency_hz: Gait frequency with interval; value None where there is no gait.
        windows: What was analysed: energies, coverage and body motion are taken over these whole
            cycles (0 cycles where there is no gait).
        wave: ``head-to-tail``, ``tail-to-head``, ``standing`` or None.
        lag_per_joint_rad: Commanded phase step from joint to joint, by plane.
        fitted: The stretch whose samples gain, lag and frequency are fitted to: the windows and
            the part of a cycle that is left over; None where there is no gait.
        groups: Joints by frequency, the largest group first, which the values above are of; one
            group where all driven joints share a frequency, none where there is no gait.
    """

    frequency_hz: Estimate
    windows: tuple[Window, ...] = ()
    wave: str | None = None
    lag_per_joint_rad: dict[str, float] = field(default_factory=dict[str, float])
    fitted: Window | None = None
    groups: tuple[GroupFacts, ...] = ()


@dataclass(frozen=True)
class JointInWindow:
    """One joint's response in one window of a constant gait.

    Attributes:
        joint: Name.
        command_amplitude_rad: Amplitude of the command.
        gain: Amplitude of the response over that of the command.
        lag_rad: Lag of the response behind the command, in (-pi, pi]; positive = late.
    """

    joint: str
    command_amplitude_rad: float | None
    gain: Estimate
    lag_rad: Estimate


@dataclass(frozen=True)
class GaitWindow:
    """One gait of a session whose gait changes.

    Attributes:
        start_s: Start of its window, from the session's start [s].
        stop_s: End [s].
        cycles: Periods in it.
        frequency_hz: Frequency of its largest group of joints.
        wave: ``head-to-tail``, ``tail-to-head``, ``standing`` or None.
        joints: In chain order.
    """

    start_s: float
    stop_s: float
    cycles: float
    frequency_hz: Estimate
    wave: str | None
    joints: tuple[JointInWindow, ...]


@dataclass(frozen=True)
class JointResult:
    """One joint's response to its command.

    Attributes:
        plane: ``horizontal``, ``vertical`` or None where no robot description says.
        command_amplitude_rad: Amplitude of the command at the frequency of its group.
        gain: Amplitude of the response over that of the command.
        lag_rad: Lag of the response behind the command, in (-pi, pi]; positive = late.
        energy_net_j: Integral of torque times velocity.
        energy_plus_j: Its positive part only.
        energy_el_j: Electrical energy at the motor, integral of u V i (signed).
        energy_el_clipped_j: Its positive part only (no regeneration).
        coverage: Fraction of the windows that has samples, 0 to 1.
        flags: Artefacts seen in the analysed stretch, e.g. ``saturated``;
            :attr:`Analysis.artefacts` says when.
        group: Index of the joint's group in :attr:`GaitFacts.groups`, 0 is the largest; None
            where the gait does not drive it.
        frequency_hz: Frequency of that group, at which gain and lag are given; or None.
        dead_band: Stick or play at the reversals, or None where none can be measured.
        gain_drift_per_cycle: Relative change of the gain, mean over the window, where it drifts;
            gain and lag are then means over the window.
        lag_drift_rad_per_cycle: The same of the lag.
        gain_transient: Relative deviation of the gain from its steady value at the start of the
            window, where the response settles; gain and lag are then the steady values.
        lag_transient_rad: The same of the lag.
        gain_cycle_sd: Standard deviation of the relative gain from cycle to cycle beyond noise;
            None where there is none.
        lag_cycle_sd_rad: The same of the lag.
        offset_rad: Mean of the response less that of the command; :attr:`Analysis.tracking` has
            it of joints that the gait does not drive.
        command_mean_rad: Mean of the command over the fitted window.
    """

    name: str
    plane: str | None
    command_amplitude_rad: float | None
    gain: Estimate
    lag_rad: Estimate
    energy_net_j: float | None
    energy_plus_j: float | None
    energy_abs_j: float | None
    energy_el_j: float | None
    energy_el_clipped_j: float | None
    coverage: float
    samples: int
    flags: tuple[str, ...] = ()
    group: int | None = None
    frequency_hz: float | None = None
    dead_band: DeadBand | None = None
    gain_drift_per_cycle: Estimate = field(default_factory=Estimate)
    lag_drift_rad_per_cycle: Estimate = field(default_factory=Estimate)
    gain_transient: Estimate = field(default_factory=Estimate)
    lag_transient_rad: Estimate = field(default_factory=Estimate)
    gain_cycle_sd: float | None = None
    lag_cycle_sd_rad: float | None = None
    offset_rad: Estimate = field(default_factory=Estimate)
    command_mean_rad: float | None = None


@dataclass(frozen=True)
class Index(WithInterval):
    """One heterogeneity index, in ``unit``.

    Attributes:
        p: p-value of the index's null, or None where no test belongs to it.
        unit: SI unit, or ``1``.
        label: What it measures, in a few words.
    """

    p: float | None = None
    unit: str = "1"
    label: str = ""


@dataclass(frozen=True, kw_only=True, repr=False)
class Analysis(PresentedResult):
    """All numbers of one session.

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
