"""Frequency responses as a table."""

from __future__ import annotations

from collections.abc import Sequence

from ...common.estimate import Estimate
from ...common.formats import scaled
from ..shown import Column, Table, typical
from .result import DIRECT, JointFrequencyResponse


def frequency_table(responses: Sequence[JointFrequencyResponse]) -> Table[JointFrequencyResponse]:
    """Return frequency responses in short: band, bandwidth, delay, distortion, repeatability."""

    def at_lowest(response: JointFrequencyResponse) -> Estimate:
        return Estimate(response.gain[0], response.gain_ci95[0])

    def agree(response: JointFrequencyResponse) -> str | None:
        return None if response.halves_agree is None else "{} of {}".format(*response.halves_agree)

    def model(response: JointFrequencyResponse) -> str:
        return (
            "group delay"
            if response.delay_model is None
            else "model {}/{}".format(*response.delay_model)
        )

    def excitation(response: JointFrequencyResponse) -> str:
        return (
            response.excitation
            if response.method == DIRECT
            else f"{response.excitation}, {response.method}"
        )

    def distortion(response: JointFrequencyResponse) -> Estimate:
        return scaled(Estimate(response.distortion), 100.0)

    columns: list[Column[JointFrequencyResponse]] = [
        Column("joint", "joint", lambda response: response.joint, kind="word"),
        Column("command", "command", excitation, kind="word", spare=2),
        Column("from Hz", "from [Hz]", lambda response: response.frequency_hz[0], (3, 4)),
        Column("to Hz", "to [Hz]", lambda response: response.frequency_hz[-1], (2, 3)),
        Column("gain there (95 %)", "gain at the lowest [1]", at_lowest, typical(4, 4)),
        Column("-3 dB Hz", "-3 dB [Hz]", lambda response: Estimate(response.bandwidth_hz), (2, 3)),
        Column(
            "delay ms (95 %)",
            "delay [ms]",
            lambda response: scaled(response.delay_s, 1e3),
            typical(2, 3),
        ),
        Column("is", "delay is", model, kind="word", spare=4),
        Column("distortion %", "distortion [%]", distortion, (2, 2), spare=3),
        Column("halves agree", "halves agree", agree, kind="word", spare=1),
    ]
    about = {
        "delay [ms]": "with the offset of the clocks",
        "distortion [%]": "nonlinear, of the response; a dash where it can't be separated from "
        "noise",
    }
    return Table(columns, responses, about=about)
