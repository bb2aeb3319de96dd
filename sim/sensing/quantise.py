"""Numbers in steps, as converters and bus frames give them."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray


def quantised(values: FloatArray, step: float) -> FloatArray:
    """Round to whole steps, halves to the even one.

    Args:
        values: Any shape.
        step: In the unit of the values; 0 leaves them as they are.

    Returns:
        The nearest multiples of the step, same shape.
    """
    return step * np.rint(values / step) if step > 0.0 else values
