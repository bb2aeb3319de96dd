"""The shape of the body and its travel, in sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ..results import formats
from ..results.body_connection import BodyConnection, PredictedTravel
from ..results.body_shape import BodyShape, PlaneShape
from ..results.estimate import Estimate
from .tables import Column, Table, typical


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
