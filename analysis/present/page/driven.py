"""Which joints took part in the gait."""

from __future__ import annotations

from ...results.analysis import JointResult

STILL_RAD = 1e-6
"""A command with less amplitude than this holds its joint still [rad]."""


def is_driven(joint: JointResult) -> bool:
    """Whether a joint was given a command that moves.

    Args:
        joint: Its result.

    Returns:
        True if it has a gain, or a command with an amplitude (and then its response is missing).
    """
    amplitude = joint.command_amplitude_rad
    return joint.gain.value is not None or (amplitude is not None and amplitude > STILL_RAD)
