"""Print numbers with the digits that a decision depends on."""

from __future__ import annotations

_MOST = 12
"""Digits after which two numbers are taken for equal."""


def percent_below(share: float, limit: float) -> str:
    """Print a share that is below a limit so that it reads as below it.

    Args:
        share: From 0 to 1.
        limit: What it was compared with, above ``share``.

    Returns:
        In percent, e.g. ``79.97 %`` for a limit of 0.8; no digits more than needed.
    """
    for decimals in range(_MOST):
        text = f"{100 * share:.{decimals}f}"
        if share >= limit or float(text) < 100 * limit:
            return f"{text} %"
    return f"{100 * share!r} %"


def distinct(first: float, second: float, digits: int = 4) -> tuple[str, str]:
    """Print two numbers so that they read as different if they are.

    Args:
        first: A number.
        second: Another.
        digits: Significant digits, at least.

    Returns:
        Both with the same number of significant digits.
    """
    for count in range(digits, _MOST):
        texts = f"{first:.{count}g}", f"{second:.{count}g}"
        if texts[0] != texts[1] or first == second:
            return texts
    return repr(first), repr(second)
