"""Couplings of the controller's oscillators in words."""

from __future__ import annotations

from collections.abc import Iterable

from ...common import formats
from .result import ChainCoupling


def chain_detail(chain: ChainCoupling) -> Iterable[str]:
    """Yield sentences on a chain of oscillators, the answer first."""
    where = f"Oscillators, {chain.plane}:"
    if not chain.identifiable:
        record = f" To decide it, record {chain.record}." if chain.record else ""
        yield f"{where} coupling not identifiable: {chain.why}.{record}"
        return
    number = chain.condition_number
    condition = formats.MISSING if number is None else f"{number:.3g}"
    strongest = max(chain.links, key=lambda link: link.K.value or 0.0)
    yield (
        f"{where} {len(chain.links)} couplings identified (condition number {condition}); "
        f"the strongest is {strongest.source} on {strongest.target}, "
        f"K = {formats.estimate(strongest.K, ' 1/s')}."
    )
    couplings = [
        f"{link.source} on {link.target} {formats.estimate(link.K)}" for link in chain.links
    ]
    yield f"K [1/s]: {'; '.join(couplings)}."
    if fed := [
        oscillator for oscillator in chain.oscillators if oscillator.feedback.value is not None
    ]:
        values = ", ".join(
            f"{oscillator.name} {formats.estimate(oscillator.feedback)}" for oscillator in fed
        )
        yield f"Feedback of each servo's own angle [1/s]: {values}."
    yield f"Method: {chain.why}, {chain.duration_s:.3g} s of phases."
