"""Energies of joints, cost of transport, and the closure against the twin's ledger."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.cycles import check_cycles
from ...common.estimate import Estimate

Each = tuple[float, ...] | None
"""One value a cycle, or None where it was not recorded or a sensor falsifies it."""


@dataclass(frozen=True)
class JointCycles:
    """Energies of one joint in each cycle of the window.

    Attributes:
        net_j: Integral of torque times velocity.
        el_j: Of motor voltage times motor current (signed).
        el_clipped_j: Of its positive part (no regeneration).
        coverage: Fraction of each cycle that has samples of mechanical power, 0 to 1.
        el_coverage: The same of electrical power.
    """

    name: str
    net_j: Each
    plus_j: Each
    abs_j: Each
    el_j: Each
    el_clipped_j: Each
    coverage: Each
    el_coverage: Each


@dataclass(frozen=True)
class Transport:
    """Cost of transport E / (m g d) over the whole cycles.

    Attributes:
        distance_m: Net displacement of the centre of mass, d.
        mass_kg: m, of the robot's description; None without one.
        net: Of E_net of all joints.
        why: Why values are missing, or empty.
    """

    distance_m: Estimate
    mass_kg: float | None
    net: Estimate
    plus: Estimate
    abs: Estimate
    el: Estimate
    el_clipped: Estimate
    why: str


@dataclass(frozen=True)
class Closure:
    """The power balance by the twin's own ledger over the window; shares of its E_abs.

    Attributes:
        mechanical_balance: What is left of mechanical work minus dissipation and stored energy.
        electrical_balance: What is left of electrical work minus mechanical work, losses and what
            rotors and gears store.
        net: E_net from the logged samples minus the ledger's.
        el_clipped: The same of E_el, clipped.
    """

    mechanical_balance: float | None
    electrical_balance: float | None
    net: float | None
    abs: float | None
    el: float | None
    plus: float | None = None
    el_clipped: float | None = None


@dataclass(frozen=True)
class EnergyResult:
    """Energies of a session beyond the joints' totals.

    Attributes:
        start_s: Start of each cycle, from the session's start [s]; one stretch without a gait.
        stop_s: Its end [s].
        electrical: What E_el is made of: ``simulated`` (the twin's motor voltage and current),
            ``motor`` (measured at the motor), ``supply`` (the voltage is the supply's, so E_el is
            an upper bound), or None.
        closure: Against the twin's ledger, or None where the log has none.
        unknown: Which energies are products of samples, so that what happens within a sampling
            interval is not in them, by an unknown amount; None where all were accumulated.
    """

    start_s: tuple[float, ...]
    stop_s: tuple[float, ...]
    joints: tuple[JointCycles, ...]
    electrical: str | None
    transport: Transport
    closure: Closure | None
    unknown: str | None = None

    def __post_init__(self) -> None:
        """Raise ValueError where values and cycles differ in number."""
        check_cycles("energy", self, len(self.start_s))
        for joint in self.joints:
            check_cycles(joint.name, joint, len(self.start_s))
