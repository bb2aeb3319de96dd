"""The shape of the body, its travel and its ground contact, in sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ..results import formats
from ..results.body_connection import BodyConnection, PredictedTravel
from ..results.body_shape import BodyShape, PlaneShape
from ..results.estimate import Estimate
from ..results.ground_contact import GroundContact
from .tables import Column, Table, typical

_LIFTED = 0.9
"""Where links are on the ground for more of a cycle, on the mean, nothing is lifted."""


def shape_lines(shape: BodyShape | None) -> Iterator[str]:
    """Yield a sentence for each plane, and one on the travel of a cycle."""
    if shape is None:
        return
    for plane in shape.planes:
        yield _plane_line(plane)
    travel = shape.travel
    if travel is not None:
        yield (
            f"Travel of a cycle: {_mm(travel.forward_m)} forward, {_mm(travel.left_m)} to the "
            f"left, turn {_degrees(travel.turn_rad)} (virtual chassis; the links are "
            f"{1000 * travel.length_m:.0f} mm along and {1000 * travel.width_m:.0f} mm across from "
            "their mean, root mean square)."
        )


def contact_lines(contact: GroundContact | None) -> Iterator[str]:
    """Yield a sentence on which links are on the ground, where they are lifted."""
    if contact is None:
        return
    links = sorted(contact.links, key=lambda one: one.share.value or 0.0)
    mean = sum(one.share.value or 0.0 for one in links) / len(links)
    if mean > _LIFTED:
        return
    least, most = (f"{_percent(one.share)} ({one.link})" for one in (links[0], links[-1]))
    right = " to ".join(f"{100 * one:.0f}" for one in contact.twin_accuracy)
    yield (
        f"Ground contact, from the joints' {contact.source}: links are on the ground {least} to "
        f"{most} of a cycle, {100 * mean:.0f} % on the mean. In the twin contact and lift are "
        f"recognised in {right} %, by the gait (chance: 50 %)."
    )


def _plane_line(plane: PlaneShape) -> str:
    curve = plane.serpenoid
    where = "" if plane.plane is None else f", {plane.plane}"
    shares = ", ".join(_percent(mode.share) for mode in plane.modes)
    speed = formats.estimate(curve.speed, " joints/s", most=2)
    if curve.speed_m_s.value is not None:
        speed += f" ({formats.estimate(curve.speed_m_s, ' m/s', most=3)})"
    return (
        f"Body shape{where}: modes with {shares} of the variance; serpenoid of "
        f"{_degrees(curve.amplitude_rad)}, {_degrees(curve.wave_number)} a joint, "
        f"{formats.estimate(curve.waves, most=3)} waves at {speed}, offset "
        f"{_degrees(curve.offset_rad)}, leaves {_percent(curve.unexplained)} unexplained."
    )


def _mm(metres: Estimate) -> str:
    return formats.estimate(formats.scaled(metres, 1000.0), " mm", most=2)


def _degrees(angle: Estimate) -> str:
    return formats.estimate(formats.degrees(angle), "°", most=2)


def _percent(share: Estimate) -> str:
    return formats.estimate(formats.scaled(share, 100.0), " %", most=2)


def travel_table(found: BodyConnection) -> Table[PredictedTravel]:
    """Return the travel of each session, predicted from the others and measured."""

    def column(
        name: str, unit: str, of: Callable[[PredictedTravel], Estimate], spare: int = 0
    ) -> Column[PredictedTravel]:
        digits = (typical(2), typical(3))
        return Column(f"{name} {unit} (95 %)", f"{name} [{unit}]", of, digits, spare=spare)

    def mm(of: Callable[[PredictedTravel], Estimate]) -> Callable[[PredictedTravel], Estimate]:
        return lambda one: formats.scaled(of(one), 1000.0)

    columns: list[Column[PredictedTravel]] = [
        Column("session", "session", lambda one: formats.filename(one.path), kind="word"),
        Column("Hz", None, lambda one: one.frequency_hz, (3, 3), spare=3),
        column("forward", "mm", mm(lambda one: one.forward_m)),
        column("measured", "mm", mm(lambda one: one.measured_forward_m)),
        column("left", "mm", mm(lambda one: one.left_m), 2),
        column("measured left", "mm", mm(lambda one: one.measured_left_m), 2),
        column("turn", "°", lambda one: formats.degrees(one.turn_rad)),
        column("measured turn", "°", lambda one: formats.degrees(one.measured_turn_rad)),
    ]
    return Table(columns, found.predicted)


def refusals(found: BodyConnection) -> Iterator[str]:
    """Yield a sentence on each session that is not predicted."""
    for one in found.predicted:
        if one.why is not None:
            yield f"{formats.filename(one.path)} is not predicted: {one.why}."
