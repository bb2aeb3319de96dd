"""Motion and shape of the body as tables and in words."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from ...common import formats
from ...common.estimate import Estimate
from ...common.formats import degrees, in_degrees, in_millimetres, in_percent, scaled
from ..shown import Column, Table
from .result import BodyPoint, BodyResult, BodyShape, PlaneShape


def body_table(body: BodyResult) -> Table[tuple[BodyPoint, ...]]:
    """Head, middle and tail, for a terminal: measured, and the nulls beside it."""
    columns: list[Column[tuple[BodyPoint, ...]]] = [
        Column(f"body, {body.plane}", None, lambda points: points[0].place, kind="word"),
        Column("link", None, lambda points: points[0].link, kind="word"),
    ]
    names = [("seen mm (95 %)", "phase° (95 %)"), *((f"{n} null mm", "phase°") for n in body.null)]
    for k, (amplitude, phase) in enumerate(names):
        columns += [
            Column(amplitude, None, partial(_point, k, phase=False), (1, 1), spare=2 if k else 0),
            Column(phase, None, partial(_point, k, phase=True), (1, 1), spare=1 if k else 0),
        ]
    return Table(columns, list(zip(body.observed, *body.null.values(), strict=True)))


def _point(k: int, points: tuple[BodyPoint, ...], *, phase: bool) -> Estimate:
    return degrees(points[k].phase_rad) if phase else scaled(points[k].amplitude_m, 1000.0)


def point_table(body: BodyResult) -> Table[tuple[str, BodyPoint]]:
    """Head, middle and tail, for the page: measured, and the nulls below it."""
    rows: list[tuple[str, BodyPoint]] = []
    for point in body.observed:
        rows.append(("measured", point))
        for name, nulls in body.null.items():
            rows += [(f"perfect tracking, {name}", n) for n in nulls if n.place == point.place]
    columns: list[Column[tuple[str, BodyPoint]]] = [
        Column(None, "place", lambda row: row[1].place, kind="word"),
        Column(None, "link", lambda row: row[1].link, kind="word"),
        Column(None, "of", lambda row: row[0], kind="word"),
        Column(None, "amplitude [mm]", lambda row: _point(0, row[1:], phase=False), (1, 1)),
        Column(None, "phase [°]", lambda row: _point(0, row[1:], phase=True), (1, 1)),
    ]
    return Table(columns, rows)


def shape_lines(shape: BodyShape | None) -> Iterator[str]:
    """Yield a sentence for each plane, and one on the travel of a cycle."""
    if shape is None:
        return
    for plane in shape.planes:
        yield _plane_line(plane)
    travel = shape.travel
    if travel is not None:
        yield (
            f"Travel of a cycle: {in_millimetres(travel.forward_m)} forward, "
            f"{in_millimetres(travel.left_m)} to the left, turn "
            f"{in_degrees(travel.turn_rad)} (virtual chassis; the links are "
            f"{1000 * travel.length_m:.0f} mm along and {1000 * travel.width_m:.0f} mm across from "
            "their mean, root mean square)."
        )


def _plane_line(plane: PlaneShape) -> str:
    curve = plane.serpenoid
    where = "" if plane.plane is None else f", {plane.plane}"
    shares = ", ".join(in_percent(mode.share) for mode in plane.modes)
    speed = formats.estimate(curve.speed, " joints/s", most=2)
    if curve.speed_m_s.value is not None:
        speed += f" ({formats.estimate(curve.speed_m_s, ' m/s', most=3)})"
    return (
        f"Body shape{where}: modes with {shares} of the variance; serpenoid of "
        f"{in_degrees(curve.amplitude_rad)}, {in_degrees(curve.wave_number)} a joint, "
        f"{formats.estimate(curve.waves, most=3)} waves at {speed}, offset "
        f"{in_degrees(curve.offset_rad)}, leaves {in_percent(curve.unexplained)} unexplained."
    )
