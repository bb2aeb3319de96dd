"""One session's numbers with what they were computed from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from undulog.capture.common.arrays import FloatArray

from ..estimators.series import Series
from ..parts.body.oscillation import MotionFit
from ..parts.body.travel import GaitCycle
from ..parts.energy.measure import Energies
from ..parts.tracking.gait import GaitOffset
from ..response.fitting import GaitFit
from ..results.analysis import Analysis
from ..signals.windows import Span


@dataclass(frozen=True)
class SessionMeasurement:
    """One session's numbers with what they were computed from; heavy, so not to be kept.

    Attributes:
        gait: The fitted gait, or None.
        responses: Measured joint angles by name, on the analysed stretch.
        span: Whole cycles over which energies are taken.
        offsets: Mean of the position less that of the command, cycle by cycle [rad], by joint.
        motion: The periodic motion of a session without commands, or None.
        cycle: One cycle of shape and motion of the body, where its pose is known, or None.
        gait_offsets: Of the joints that the gait drives, by name.
    """

    analysis: Analysis
    gait: GaitFit | None
    responses: Mapping[str, Series]
    energies: Mapping[str, Energies]
    span: Span
    offsets: Mapping[str, FloatArray]
    motion: MotionFit | None = None
    cycle: GaitCycle | None = None
    gait_offsets: Mapping[str, GaitOffset] = field(default_factory=dict[str, GaitOffset])
