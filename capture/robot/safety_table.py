"""The ``safety`` and ``safety_of`` tables of a robot description."""

from __future__ import annotations

from ..common.strict_table import Table
from .model import Joint
from .safety import JOINT_LIMITS, OnFault, Safety

_ANY_SIGN = ("max_temperature",)
_TIMES = ("reply_timeout_s", "max_late_s")


def read_safety(top: Table, joints: tuple[Joint, ...]) -> Safety | None:
    """Read ``safety``, and what single joints have otherwise.

    Args:
        top: The description.
        joints: Its joints.

    Returns:
        The limits that are given; None without the table.
    """
    if "safety" not in top:
        if "safety_of" in top:
            top.fault("safety_of", "leave it out: there is no safety for it to differ from")
        return None
    table = top.table("safety")
    common = {limit: _limit(table, limit) for limit in (*JOINT_LIMITS, *_TIMES)}
    fault_after_s = table.number("fault_after_s", default=Safety.fault_after_s, above=0)
    on_fault = Safety.on_fault
    if "on_fault" in table:
        on_fault = table.choice("on_fault", OnFault) or on_fault
    table.close()
    singles = top.table("safety_of")
    of: list[tuple[str, str, float]] = []
    for joint in joints:
        own = singles.table(joint.name)
        given = ((joint.name, limit, _limit(own, limit)) for limit in JOINT_LIMITS)
        of += [(name, limit, value) for name, limit, value in given if value is not None]
        own.close()
    singles.close()
    return Safety(**common, fault_after_s=fault_after_s, on_fault=on_fault, of=tuple(of))


def _limit(table: Table, name: str) -> float | None:
    """One limit; None where it isn't given."""
    if name not in table:
        return None
    return table.number(name, above=None if name in _ANY_SIGN else 0)
