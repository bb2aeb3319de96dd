"""Numbers as people read them: degrees, decimals that fit the interval, a true minus sign.

A value keeps its full precision in the page (``<data value=...>``); what is printed here is
rounded by its interval, as the Particle Data Group does (Review of Particle Physics,
Introduction, section 5.3): two digits of the half width if they are 35 or less, else one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime

from undulog.capture.common.console import plain

from .estimate import Estimate, Interval

MISSING = "\N{EN DASH}"
"""Printed where a value could not be computed."""

MINUS = "\N{MINUS SIGN}"

LEVEL = 0.05
"""Below it a p-value decides; what is printed stays on the side where the p-value is."""

_MORE_DIGITS = 6
"""Digits that a sentence may add so that what decides is seen."""

_LONG = 1e9
"""From here on numbers have an exponent: a damaged sample can be of any size."""


def number(value: float | None, decimals: int) -> str:
    """Format a number with fixed decimals, or an en dash.

    Args:
        value: Any unit; None or not finite prints as an en dash.
        decimals: Digits after the point, at least 0.

    Returns:
        For example ``−0.016``.
    """
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:.{decimals}f}" if abs(value) < _LONG else f"{value:.3g}"
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", MINUS)


def interval(ci95: Interval | None, decimals: int) -> str:
    """Format a 95 % interval in square brackets, or an empty string.

    Returns:
        For example ``[5.9, 6.5]``.
    """
    if ci95 is None:
        return ""
    low, high = ci95
    return f"[{number(low, decimals)}, {number(high, decimals)}]"


def estimate(quantity: Estimate, unit: str = "", *, most: int = 3) -> str:
    """Format a value with its unit and its interval, for a sentence.

    Args:
        quantity: The estimate, already in ``unit``.
        unit: Written behind the value, with its own space where it wants one, e.g. ``" Hz"``.
        most: Digits after the point at most; as many as the interval deserves.

    Returns:
        For example ``6.2° [5.9, 6.5]``; an en dash where the value is missing. An interval that
        excludes zero is never printed with an end at zero: it has as many digits as that takes.
    """
    if quantity.value is None:
        return MISSING
    digits = decimals_for([quantity], most=most)
    if quantity.ci95 is not None:
        digits = _beside_zero(quantity.ci95, digits)
    text = number(quantity.value, digits) + unit
    return text if quantity.ci95 is None else f"{text} {interval(quantity.ci95, digits)}"


def _beside_zero(ci95: Interval, digits: int) -> int:
    """Return digits that show that an interval excludes zero, at least the given ones."""
    low, high = ci95
    end = min(abs(low), abs(high))
    if not (low * high > 0 and math.isfinite(end)):
        return digits
    needed = math.floor(-math.log10(2 * end)) + 1  # beyond half a unit of the last digit
    return max(digits, min(needed, digits + _MORE_DIGITS))


def decimals_for(quantities: Iterable[Estimate], least: int = 1, most: int = 5) -> int:
    """Return decimals that show one or two digits of the typical half width of the intervals.

    Args:
        quantities: Estimates of one table column, in the unit they are printed in.

    Returns:
        Digits after the point, the same for the whole column so that it lines up. Without any
        interval, four digits of the largest value.
    """
    estimates = list(quantities)
    ends = (q.ci95 for q in estimates if q.ci95 is not None)
    if half := sorted(0.5 * (high - low) for low, high in ends if high > low):
        decimals = _decimals_of(half[len(half) // 2])
    else:
        decimals = decimals_for_values((q.value for q in estimates), 4)
    return min(max(decimals, least), most)


def _decimals_of(half_width: float) -> int:
    """Return decimals by the Particle Data Group: 0.0354 shows 0.035, 0.0355 shows 0.04."""
    if not math.isfinite(half_width):
        return 0
    power = math.floor(math.log10(half_width))
    return (1 if half_width / 10.0**power <= 3.54 else 0) - power


def decimals_for_values(values: Iterable[float | None], digits: int = 3) -> int:
    """Return decimals that show so many significant digits of the largest value.

    Args:
        values: One table column; None is skipped.
        digits: Significant digits of the largest.

    Returns:
        Digits after the point, 0 to 6.
    """
    largest = max([abs(v) for v in values if v is not None and math.isfinite(v)], default=0.0)
    power = math.floor(math.log10(largest)) if largest else digits
    return min(max(digits - 1 - power, 0), 6)


def degrees(quantity: Estimate) -> Estimate:
    """Convert an estimate to degrees."""
    return scaled(quantity, 180.0 / math.pi)


def scaled(quantity: Estimate, factor: float) -> Estimate:
    """Convert an estimate to another unit.

    Args:
        factor: New units in one old unit, positive.

    Returns:
        Value and interval times ``factor``.
    """
    value, ci95 = quantity.value, quantity.ci95
    return Estimate(
        None if value is None else value * factor,
        None if ci95 is None else (ci95[0] * factor, ci95[1] * factor),
    )


def percent(share: Estimate) -> str:
    """Format a share with its interval.

    Args:
        share: 0 to 1.

    Returns:
        For example ``97 % [91, 99]``; an en dash where it is missing.
    """
    return estimate(scaled(share, 100.0), " %", most=1)


def coverage(share: float) -> str:
    """Return a covered share of time, rounded down: only what is whole is ``100 %``.

    Args:
        share: 0 to 1.

    Returns:
        For example ``98 %`` or ``99.9 %``.
    """
    factor = 10 if 100.0 * share > 99.0 else 1
    return f"{math.floor(factor * (100.0 * share) + 1e-6) / factor:g} %"


def relative(log_gain: Estimate) -> Estimate:
    """Convert a difference of ln gain to percent."""
    value, ci95 = log_gain.value, log_gain.ci95
    return Estimate(
        None if value is None else 100 * math.expm1(value),
        None if ci95 is None else (100 * math.expm1(ci95[0]), 100 * math.expm1(ci95[1])),
    )


def p_value(p: float | None) -> str:
    """Return a p-value: three decimals, never a bare zero, on its own side of 5 %.

    Args:
        p: 0 to 1, or None.

    Returns:
        For example ``0.013`` or ``< 0.001``; more decimals where three would move it to the other
        side of :data:`LEVEL`, e.g. ``0.0498``.
    """
    if p is None or not math.isfinite(p):
        return MISSING
    if p < 0.001:
        return "< 0.001"
    digits = 3
    while (round(p, digits) < LEVEL) != (p < LEVEL):
        digits += 1
    return f"{p:.{digits}f}"


def p_value_text(p: float | None) -> str:
    """Format a p-value with its name.

    Returns:
        For example ``p = 0.013`` or ``p < 0.001``.
    """
    text = p_value(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def utc(time_ns: int) -> str:
    """Format a Unix time as date and time of day in UTC.

    Args:
        time_ns: Unix time [ns].

    Returns:
        For example ``2026-03-01 09:30:00 UTC``; the bare number where no calendar reaches it.
    """
    try:
        moment = datetime.fromtimestamp(time_ns // 1_000_000_000, tz=UTC)
    except (OverflowError, OSError, ValueError):
        return f"{time_ns} ns"
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def short(text: str, most: int = 40) -> str:
    """Shorten text to fit into a figure.

    Args:
        most: Characters kept at most; the middle gives way, since names differ at their ends.
    """
    whole = plain(text)
    cut = whole[: most // 2] + "\N{HORIZONTAL ELLIPSIS}" + whole[-(most - most // 2 - 1) :]
    return whole if len(whole) <= most else cut


def filename(path: str) -> str:
    """Return the last part of a path of any system."""
    return plain(path.replace("\\", "/").rstrip("/").rpartition("/")[2] or path)


def sentence(text: str) -> str:
    """Format text with a capital at its beginning and one stop at its end.

    Args:
        text: From a log or a result; a name at its beginning keeps its own letters.
    """
    return capital(plain(text).strip().rstrip(".")) + "."


def capital(text: str) -> str:
    """Capitalise text; a name keeps its own letters."""
    first = text.partition(" ")[0]
    if first.endswith(":") or any(c in "._/\\" or c.isdigit() for c in first):
        return text
    return text[:1].upper() + text[1:]


def in_millimetres(length: Estimate) -> str:
    """Format a length [m] in mm."""
    return estimate(scaled(length, 1000.0), " mm", most=2)


def in_degrees(angle: Estimate) -> str:
    """Format an angle [rad] in degrees."""
    return estimate(degrees(angle), "°", most=2)


def in_percent(share: Estimate) -> str:
    """Format a share in percent."""
    return estimate(scaled(share, 100.0), " %", most=2)
