"""Whether a session can tell how the joints are coupled."""

from __future__ import annotations

from ..results.coupling import Coupling


def one_gait_coupling(joints: int) -> Coupling:
    """What one steady gait says about the coupling: nothing, and what would.

    Args:
        joints: Joints with a known response, m.

    Returns:
        Not identifiable, with the reason and the plan to record.
    """
    if joints == 0:
        return Coupling(
            identifiable=False,
            why="no joint's response to a gait is known",
            record="a session with a steady gait, commands and responses",
        )
    if joints == 1:
        return Coupling(
            identifiable=False,
            why="one joint has no neighbour whose response is known",
            record="a session with a chain of driven joints",
        )
    return Coupling(
        identifiable=False,
        why=f"one gait gives {joints} complex numbers for {joints * joints} unknown couplings",
        record=f"phase-kicks around this gait ({4 * joints} runs: each joint's command kicked up "
        f"and down, in phase and in amplitude), or without contact a lag-sweep of {joints} gaits",
    )
