"""Feedback held against its limits, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

from .faults import FaultKind, GateFault
from .limits import GateLimits
from .status import JointStatus

_SHOWN = 4


@dataclass(frozen=True)
class _Excess:
    """One quantity that must not stay beyond its limit."""

    kind: FaultKind
    what: str
    unit: str
    less: bool = False


_EXCESSES = (
    _Excess(FaultKind.CURRENT, "current", "A"),
    _Excess(FaultKind.TEMPERATURE, "temperature", "degC"),
    _Excess(FaultKind.VOLTAGE, "voltage", "V", less=True),
    _Excess(FaultKind.TRACKING, "tracking error", "rad"),
)


class Watch:
    """Looks at each tick's readings and says what is wrong, the first time that it is."""

    def __init__(self, limits: GateLimits) -> None:
        """Nothing is wrong yet.

        Args:
            limits: What is allowed.
        """
        self._limits = limits
        self._bounds = {
            FaultKind.CURRENT: limits.current,
            FaultKind.TEMPERATURE: limits.temperature,
            FaultKind.VOLTAGE: limits.voltage,
            FaultKind.TRACKING: limits.tracking_error,
        }
        count = len(limits.joint_names)
        self._since_s = {each.kind: np.full(count, np.nan) for each in _EXCESSES}

    def look(self, time_s: float, status: JointStatus, command: FloatArray) -> GateFault | None:
        """Look at what is known at a tick.

        Args:
            time_s: Now, on the loop's clock [s].
            status: What the joints told.
            command: What they were commanded last [rad], shape (m,).

        Returns:
            The fault, None if all is well.
        """
        values = {
            FaultKind.CURRENT: np.abs(status.current),
            FaultKind.TEMPERATURE: status.temperature,
            FaultKind.VOLTAGE: status.voltage,
            FaultKind.TRACKING: np.abs(status.angle - command),
        }
        lost = self._lost(time_s, status.silence_s)
        found = [self._excess(each, time_s, values[each.kind]) for each in _EXCESSES]
        return next((fault for fault in (lost, *found) if fault is not None), None)

    def _lost(self, time_s: float, silence_s: FloatArray) -> GateFault | None:
        limit_s = self._limits.reply_timeout_s
        silent = silence_s > limit_s
        if not silent.any():
            return None
        names = _named(self._limits.joint_names, silent)
        value = float(np.max(silence_s[silent]))
        return GateFault(
            FaultKind.LOST,
            f"{names} lost: no angle for more than {limit_s:g} s",
            joint=self._limits.joint_names[int(np.argmax(silent))] if silent.sum() == 1 else "",
            value=value,
            limit=limit_s,
            since_s=time_s - value,
        )

    def _excess(self, of: _Excess, time_s: float, values: FloatArray) -> GateFault | None:
        bound = self._bounds[of.kind]
        beyond = values < bound if of.less else values > bound  # False for NaN
        began = self._since_s[of.kind]
        since_s = np.where(beyond, np.where(np.isnan(began), time_s, began), np.nan)
        self._since_s[of.kind] = since_s
        due = beyond & (time_s - since_s >= self._limits.fault_after_s - 1e-9)
        if not due.any():
            return None
        far = np.where(due, np.abs(values - bound), -np.inf)
        joint = int(np.argmax(far))
        name, value, limit = self._limits.joint_names[joint], values[joint], bound[joint]
        than = "less than" if of.less else "more than"
        lasted = time_s - since_s[joint]
        return GateFault(
            of.kind,
            f"{name}: {of.what} {value:.3g} {of.unit}, {than} {limit:g} {of.unit} "
            f"for {lasted:.2g} s",
            joint=name,
            value=float(value),
            limit=float(limit),
            since_s=float(since_s[joint]),
        )


def _named(names: tuple[str, ...], chosen: BoolArray) -> str:
    """Who, as the subject of a sentence."""
    if chosen.all():
        return "the robot is"
    found = [name for name, is_one in zip(names, chosen, strict=True) if is_one]
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return ", ".join(found[:_SHOWN]) + more + (" is" if len(found) == 1 else " are")
