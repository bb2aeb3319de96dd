"""Oscillators in words: the couplings of a chain, and what the body adds."""

from __future__ import annotations

from collections.abc import Iterable

from ...results import formats
from ...results.oscillators import BodyOscillators, ChainCoupling, Link


def chain_detail(chain: ChainCoupling) -> Iterable[str]:
    """A chain of oscillators, told from its phases.

    Args:
        chain: The result.

    Yields:
        Sentences; the first is the answer.
    """
    where = f"Oscillators, {chain.plane}:"
    if not chain.identifiable:
        record = f" To tell it, record {chain.record}." if chain.record else ""
        yield f"{where} coupling not identifiable: {chain.why}.{record}"
        return
    number = chain.condition_number
    condition = formats.MISSING if number is None else f"{number:.3g}"
    strongest = max(chain.links, key=lambda link: link.K.value or 0.0)
    yield (
        f"{where} {len(chain.links)} couplings told (condition number {condition}); the strongest "
        f"is {strongest.source} on {strongest.target}, K = {formats.estimate(strongest.K, ' 1/s')}."
    )
    yield f"K [1/s]: {'; '.join(_link(link) for link in chain.links)}."
    fed = [one for one in chain.oscillators if one.feedback.value is not None]
    if fed:
        told = ", ".join(f"{one.name} {formats.estimate(one.feedback)}" for one in fed)
        yield f"Feedback of each servo's own angle [1/s]: {told}."
    yield f"Method: {chain.why}, {chain.duration_s:.3g} s of phases."


def body_detail(body: BodyOscillators) -> Iterable[str]:
    """What oscillators that feel their servos would do on this body.

    Args:
        body: The result.

    Yields:
        Sentences; the first is the answer.
    """
    yield f"Oscillators that feel their servos: {body.answer}."
    worst = max(mode.sensitivity for mode in body.modes)
    noise = body.pseudospectrum.noise
    yield (
        f"I - P is a signed Laplacian and not normal (a rate moves by up to {worst:.1f} times an "
        f"error of P, whose norm is below {noise:.2g}); a deviation may grow for a while at "
        f"{formats.estimate(body.growth, ' eps')}."
    )


def _link(link: Link) -> str:
    return f"{link.source} on {link.target} {formats.estimate(link.K)}"
