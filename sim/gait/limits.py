"""How a wave starts, and how it is kept within the joints' limits."""

from __future__ import annotations


def smoothstep(x: float) -> float:
    """Rise from 0 to 1 with no slope at either end, 3 x^2 - 2 x^3.

    Args:
        x: Where; clipped to 0 to 1.

    Returns:
        The value.
    """
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def within_limits(
    amplitude: float, offset: float, lower: float, upper: float
) -> tuple[float, float]:
    """Cut offset, then amplitude, so that offset +- amplitude stays within the limits.

    The wave keeps its shape: a cut sine would have flat tops, and harmonics that no one commanded.

    Args:
        amplitude: Wanted, not negative [rad].
        offset: Wanted [rad].
        lower: Lower limit [rad].
        upper: Upper limit [rad].

    Returns:
        Amplitude and offset [rad].
    """
    offset = min(max(offset, lower), upper)
    return min(amplitude, upper - offset, offset - lower), offset
