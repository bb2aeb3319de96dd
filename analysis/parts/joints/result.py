"""What is measured of a joint."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ...common.estimate import Estimate
from ..dead_band.result import DeadBand

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class JointResult:
    """One joint's response to its command.

    Attributes:
        plane: ``horizontal``, ``vertical`` or None where no robot description says.
        command_amplitude_rad: Amplitude of the command at the frequency of its group.
        gain: Amplitude of the response over that of the command.
        lag_rad: Lag of the response behind the command, in (-pi, pi]; positive = late.
        energy_net_j: Integral of torque times velocity.
        energy_plus_j: Its positive part only.
        energy_el_j: Electrical energy at the motor, integral of u V i (signed).
        energy_el_clipped_j: Its positive part only (no regeneration).
        coverage: Fraction of the windows that has samples, 0 to 1.
        flags: Artefacts seen in the analysed stretch, e.g. ``saturated``;
            :attr:`Analysis.artefacts` says when.
        group: Index of the joint's group in :attr:`GaitFacts.groups`, 0 is the largest; None
            where the gait does not drive it.
        frequency_hz: Frequency of that group, at which gain and lag are given; or None.
        dead_band: Stick or play at the reversals, or None where none can be measured.
        gain_drift_per_cycle: Relative change of the gain, mean over the window, where it drifts;
            gain and lag are then means over the window.
        lag_drift_rad_per_cycle: The same of the lag.
        gain_transient: Relative deviation of the gain from its steady value at the start of the
            window, where the response settles; gain and lag are then the steady values.
        lag_transient_rad: The same of the lag.
        gain_cycle_sd: Standard deviation of the relative gain from cycle to cycle beyond noise;
            None where there is none.
        lag_cycle_sd_rad: The same of the lag.
        offset_rad: Mean of the response less that of the command; :attr:`Analysis.tracking` has
            it of joints that the gait does not drive.
        command_mean_rad: Mean of the command over the fitted window.
    """

    name: str
    plane: str | None
    command_amplitude_rad: float | None
    gain: Estimate
    lag_rad: Estimate
    energy_net_j: float | None
    energy_plus_j: float | None
    energy_abs_j: float | None
    energy_el_j: float | None
    energy_el_clipped_j: float | None
    coverage: float
    samples: int
    flags: tuple[str, ...] = ()
    group: int | None = None
    frequency_hz: float | None = None
    dead_band: DeadBand | None = None
    gain_drift_per_cycle: Estimate = field(default_factory=Estimate)
    lag_drift_rad_per_cycle: Estimate = field(default_factory=Estimate)
    gain_transient: Estimate = field(default_factory=Estimate)
    lag_transient_rad: Estimate = field(default_factory=Estimate)
    gain_cycle_sd: float | None = None
    lag_cycle_sd_rad: float | None = None
    offset_rad: Estimate = field(default_factory=Estimate)
    command_mean_rad: float | None = None
