"""Which physics engine and which kernels a scenario asks for."""

from __future__ import annotations

from enum import StrEnum


class EngineKind(StrEnum):
    """The engines there are, each named after its package."""

    BULLET = "bullet"
    MUJOCO = "mujoco"

    @property
    def package(self) -> str:
        """Name of its package in the package index."""
        return {EngineKind.BULLET: "pybullet", EngineKind.MUJOCO: "mujoco"}[self]


class Kernels(StrEnum):
    """What computes the force laws, and the body's kinematics where that pays.

    Results of the two agree within rounding, not bit by bit, so the default does not depend on what
    is installed.
    """

    NUMPY = "numpy"
    NUMBA = "numba"
