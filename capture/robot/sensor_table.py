"""The sensors of a robot description."""

from __future__ import annotations

from ..common.strict_table import Table, listed
from .model import Link, Sensor, SensorKind
from .repeated import note_repeated

_RANGED = (SensorKind.IR, SensorKind.SONAR)


def read_sensors(top: Table, defaults: Table, links: tuple[Link, ...]) -> tuple[Sensor, ...]:
    """Read ``sensors``, with ``defaults`` of each kind.

    Args:
        top: The description.
        defaults: Its ``defaults``.
        links: The links that may carry them.

    Returns:
        The sensors.
    """
    common = {kind: defaults.table(kind) for kind in SensorKind}
    used: set[SensorKind] = set()
    sensors: list[Sensor] = []
    for values, where in top.tables("sensors"):
        kind = Table(values, where, top.faults).choice("kind", SensorKind)
        if kind is not None:
            used.add(kind)
            table = Table(values, where, top.faults, common[kind])
            table.choice("kind", SensorKind)
            sensors.append(_sensor(table, kind, [link.name for link in links]))
            table.close()
    for kind, table in common.items():
        if kind in used:
            table.close()
        elif kind in defaults:
            defaults.fault(kind, f"leave it out: no sensor is of kind {kind}")
    topics = [sensor.topic for sensor in sensors]
    note_repeated(top.faults, "topics of the sensors", topics)
    return tuple(sensors)


def _sensor(table: Table, kind: SensorKind, link_names: list[str]) -> Sensor:
    name, link = table.name("name"), table.text("link")
    if link and link not in link_names:
        table.fault("link", listed(link_names, link))
    position = table.triple("position")
    rpy = table.triple("rpy", default=(0.0, 0.0, 0.0))
    range_min = range_max = field_of_view = None
    axes: tuple[str, ...] = ()
    fields = ["link", "position", "rpy"]
    if kind in _RANGED:
        range_min = table.number("range_min", at_least=0)
        range_max = table.number("range_max", above=0)
        if range_min >= range_max:
            table.fault("range_max", f"more than range_min = {range_min:g}", f"{range_max:g}")
        field_of_view = table.number("field_of_view", above=0, at_most=6.29)
        fields += ["range_min", "range_max", "field_of_view"]
    else:
        axes = table.words("axes", valid=("x", "y", "z"))
        if not axes:
            table.fault("axes", 'an array of the measured axes, e.g. ["x", "y"]')
        fields += ["axes"]
    return Sensor(
        name=name,
        kind=kind,
        link=link,
        position=position,
        rpy=rpy,
        range_min=range_min,
        range_max=range_max,
        field_of_view=field_of_view,
        axes=axes,
        assumed=table.words("assumed", valid=fields),
    )
