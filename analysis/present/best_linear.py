"""Best linear approximations as a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from ..results.estimate import Estimate
from ..results.formats import scaled
from ..results.frequency_response import BestLinearJoint
from .tables import Column, Table, typical


def best_linear_table(found: Sequence[BestLinearJoint]) -> Table[BestLinearJoint]:
    """Return best linear approximations in short: band, bandwidth, delay, noise, distortion."""

    def noise(one: BestLinearJoint) -> Estimate:
        gain = math.hypot(*one.response.gain)
        known = one.noise_sd is not None and gain > 0
        return Estimate(100 * math.hypot(*one.noise_sd or ()) / gain if known else None)

    def share(
        name: str, of: Callable[[BestLinearJoint], Estimate], note: str, spare: int = 0
    ) -> Column[BestLinearJoint]:
        digits = (typical(2), typical(3))
        return Column(
            f"{name} % (95 %)",
            f"{name} [%]",
            lambda one: scaled(of(one), 100.0),
            digits,
            spare=spare,
            note=note,
        )

    columns: list[Column[BestLinearJoint]] = [
        Column("joint", "joint", lambda one: one.response.joint, kind="word"),
        Column("from Hz", "from [Hz]", lambda one: one.response.frequency_hz[0], (3, 4), spare=6),
        Column("to Hz", "to [Hz]", lambda one: one.response.frequency_hz[-1], (2, 3), spare=6),
        Column(
            "gain there (95 %)",
            "gain at the lowest [1]",
            lambda one: Estimate(one.response.gain[0], one.response.gain_ci95[0]),
            (typical(4), typical(4)),
            spare=1,
        ),
        Column("-3 dB Hz", "-3 dB [Hz]", lambda one: Estimate(one.response.bandwidth_hz), (2, 3)),
        Column(
            "delay ms (95 %)",
            "delay [ms]",
            lambda one: scaled(one.response.delay_s, 1e3),
            (typical(2), typical(3)),
            spare=2,
            note="with the offset of the clocks",
        ),
        Column("noise %", "noise [%]", noise, (2, 3), spare=3, note="of the mean response"),
        share(
            "distortion",
            lambda one: one.distortion,
            "nonlinear, over the gain, root mean squares over the lines; a dash where it can't be "
            "separated from noise",
        ),
        share(
            "odd",
            lambda one: one.odd,
            "response at odd lines that the command leaves out, over that at its own",
            spare=5,
        ),
        share("even", lambda one: one.even, "the same at even lines", spare=4),
    ]
    return Table(columns, found)
