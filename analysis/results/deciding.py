"""Print numbers with the digits that a decision depends on."""

from __future__ import annotations

_MOST = 12
"""Digits after which two numbers are taken for equal."""


def percent(share: float, limit: float) -> str:
    """Print a share so that it reads as on the side of a limit that it is on.

    Args:
        share: Any share.
        limit: What it was compared with.

    Returns:
        In percent with no digits more than needed, e.g. ``79.97 %`` for a limit of 0.8.
    """
    for decimals in range(_MOST):
        text = f"{100 * share:.{decimals}f}"
        if _same_side(float(text) / 100, share, limit):
            return f"{text} %"
    return f"{100 * share!r} %"


def beyond(value: float, limit: float, digits: int = 2) -> str:
    """Print a value so that it reads as on the side of a limit that it is on.

    Args:
        value: Any value.
        limit: What it was compared with.
        digits: Significant digits, at least.

    Returns:
        The value, e.g. ``101`` for a limit of 100, where two digits would be 1e+02.
    """
    for count in range(digits, _MOST):
        text = f"{value:.{count}g}"
        if _same_side(float(text), value, limit):
            return text
    return repr(value)


def _same_side(printed: float, value: float, limit: float) -> bool:
    return value == limit or (printed != limit and (printed > limit) == (value > limit))


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
