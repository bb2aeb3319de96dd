"""The gaits of a session's windows as tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ...common.estimate import Estimate
from ...common.formats import degrees
from ..shown import Column, Ends, ShownNumber, Table, typical
from .result import GaitWindow


def gait_table(gaits: Sequence[GaitWindow]) -> Table[GaitWindow]:
    """Return the gaits of a session whose gait changes, a row each."""

    def gains(gait: GaitWindow) -> Ends | None:
        return _ends([joint.gain for joint in gait.joints], 3)

    def lags(gait: GaitWindow) -> Ends | None:
        return _ends([degrees(joint.lag_rad) for joint in gait.joints], 1)

    columns: list[Column[GaitWindow]] = [
        Column("gait from s", "from [s]", lambda gait: gait.start_s, (2, 2)),
        Column("to s", "to [s]", lambda gait: gait.stop_s, (2, 2)),
        Column("Hz (95 %)", "frequency [Hz]", lambda gait: gait.frequency_hz, typical(3, 4)),
        Column("cycles", "cycles", lambda gait: gait.cycles, (1, 1), spare=1),
        Column("wave", "wave", lambda gait: gait.wave, kind="word"),
        Column("gains", "gain, all joints [1]", gains),
        Column("lags °", "lag, all joints [°]", lags),
    ]
    return Table(columns, gaits)


def gait_joint_table(gaits: Sequence[GaitWindow]) -> Table[str]:
    """Return gain and lag of each joint in each gait, a row a joint; for the page."""
    joints = [{joint.joint: joint for joint in gait.joints} for gait in gaits]
    names = list(dict.fromkeys(name for by_name in joints for name in by_name))

    def gain(gait: int) -> Callable[[str], Estimate | None]:
        return lambda name: joints[gait][name].gain if name in joints[gait] else None

    def lag(gait: int) -> Callable[[str], Estimate | None]:
        return lambda name: degrees(joints[gait][name].lag_rad) if name in joints[gait] else None

    columns: list[Column[str]] = [Column("joint", "joint", lambda name: name, kind="word")]
    for k, gait in enumerate(gaits):
        when = f"{gait.start_s:.0f} to {gait.stop_s:.0f} s"
        columns += [
            Column(None, f"gain, {when} [1]", gain(k), typical(3, 4)),
            Column(None, f"lag, {when} [°]", lag(k), typical(2, 3)),
        ]
    return Table(columns, names)


def _ends(estimates: Sequence[Estimate], decimals: int) -> Ends | None:
    """Return the lowest and the highest value, or None where there is none."""
    values = [estimate.value for estimate in estimates if estimate.value is not None]
    if not values:
        return None
    return Ends(*(ShownNumber(Estimate(end), decimals) for end in (min(values), max(values))))
