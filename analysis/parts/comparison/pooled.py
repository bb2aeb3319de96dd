"""The same joints in several gaits, as one chain.

In gait w, ln H of joint j is x_jw with the variance v_jw. What the joints do in all gaits is the
weighted mean of the gaits, with weights that are the same for all joints, so that the mean of a
contrast is the contrast of the means::

    x_j = sum_w a_w x_jw,    a_w = p_w / sum_w p_w,    p_w = mean over j of 1 / v_jw

The noise of different gaits is independent: the variance of any sum of joints is that with a_w^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ...response.response import Response
from .examine import Chain
from .profile import Scatter


def over_gaits(chains: Sequence[Sequence[Chain]]) -> list[Chain]:
    """Pool the chains of several gaits.

    Args:
        chains: Of each gait, by plane and group.

    Returns:
        One chain for each plane and group: joints that are in it in all gaits that have it.
    """
    same: dict[tuple[str, int], list[Chain]] = {}
    for gait in chains:
        for chain in gait:
            if chain.names and chain.errors is not None:
                same.setdefault((chain.plane, chain.group), []).append(chain)
    return [_pooled(some) for some in same.values()]


def _pooled(chains: Sequence[Chain]) -> Chain:
    names = tuple(n for n in chains[0].names if all(n in chain.names for chain in chains[1:]))
    some = [_select(chain, names) for chain in chains]
    responses = [chain.response for chain in some]
    weights = np.array([_precision(response) for response in responses])
    weights /= weights.sum()
    ratios = np.stack([response.ratio for response in responses])
    unit = np.mean(ratios / np.abs(ratios), axis=0)
    unit /= np.abs(unit)
    logs = np.log(ratios * unit.conj())  # the phases of a joint within pi of their mean
    gain, lag = (
        _mixed([chain.errors[k] for chain in some if chain.errors is not None], weights)
        for k in (0, 1)
    )
    squared = weights[:, np.newaxis] ** 2
    response = Response(
        unit * np.exp(weights @ logs),
        np.sum(squared * [response.log_gain_variance for response in responses], axis=0),
        np.sum(squared * [response.lag_variance for response in responses], axis=0),
        np.sum([response.dof for response in responses], axis=0),
    )
    return replace(some[0], names=names, response=response, scatter=(gain, lag))


def _select(chain: Chain, names: Sequence[str]) -> Chain:
    index = [chain.names.index(name) for name in names]
    scatter = chain.scatter
    if scatter is not None:
        scatter = scatter[0].select(index), scatter[1].select(index)
    return replace(
        chain, names=tuple(names), response=chain.response.select(index), scatter=scatter
    )


def _precision(response: Response) -> float:
    variance: FloatArray = response.log_gain_variance + response.lag_variance
    return float(np.mean(1 / np.maximum(variance, np.finfo(np.float64).tiny)))


def _mixed(scatters: Sequence[Scatter], weights: FloatArray) -> Scatter:
    """Return the scatter of the weighted mean of independent values."""
    count = sum(scatter.columns.shape[1] for scatter in scatters)
    columns = [
        weight * np.sqrt(count / scatter.columns.shape[1]) * scatter.columns
        for weight, scatter in zip(weights, scatters, strict=True)
    ]
    squared = weights**2
    return Scatter(
        np.concatenate(columns, axis=1),
        squared @ np.stack([scatter.unshared for scatter in scatters]),
        weights @ np.stack([scatter.turn for scatter in scatters]),
    )
