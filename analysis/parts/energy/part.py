"""The parts that measure energies: of the joints, then of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..part import Part, Results
from .measure import Energies, check_ledger, energy_result, joint_energies, transport
from .result import Closure, EnergyResult


@dataclass(frozen=True)
class MeasuredEnergy:
    """Energies of the joints.

    Attributes:
        joints: By name.
        closure: Against the twin's ledger, or None.
    """

    joints: Mapping[str, Energies]
    closure: Closure | None


def _energies(signals: Signals, done: Results, remarks: Remarks) -> MeasuredEnergy:
    session, span = signals.session, done[GAIT].span
    held = done[ARTEFACTS].window
    energies = joint_energies(session, signals.columns, held, span, remarks)
    return MeasuredEnergy(energies, check_ledger(session, energies.values(), span, remarks))


ENERGIES = Part("energies", _energies, ("artefacts", "gait"))


def _energy(signals: Signals, done: Results, remarks: Remarks) -> EnergyResult | None:
    session, span, energies = signals.session, done[GAIT].span, done[ENERGIES]
    cost = transport(session, done[ARTEFACTS].sound, energies.joints, span, remarks)
    session.forget()
    return energy_result(
        session,
        signals.columns,
        energies.joints,
        span,
        transport=cost,
        closure=energies.closure,
        warn=remarks,
    )


ENERGY = Part("energy", _energy, ("artefacts", "gait", "energies"))

PARTS = (
    ENERGIES,
    ENERGY,
)
