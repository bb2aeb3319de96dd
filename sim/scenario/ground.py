"""What the ground is made of."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FrictionLaw(StrEnum):
    """How the ground resists a link that slips along it.

    The first three are Coulomb's, proportional to the normal force; they differ in how the two
    coefficients combine when a link slips obliquely. The last one is a fluid's.

    ``ellipse``: greatest dissipation on the ellipse (F_t/mu_t)^2 + (F_n/mu_n)^2 = N^2, the
    convex anisotropic Coulomb law (Goyal, Ruina & Papadopoulos, Wear 143, 1991).
    ``box``: each axis on its own, F_i = mu_i N sgn(v_i), the literal reading of Meister,
    Stepanenko & Kernbach 2011.
    ``transeth``: F_i = mu_i N v_i / |v| (Transeth, Leine, Glocker & Pettersen, IEEE Trans.
    Robotics 24, 2008).
    ``viscous``: F_i = -c_i v_i, whatever the normal force, on every link that touches the surface:
    resistive-force theory (Gray & Hancock, J. Exp. Biol. 32, 1955), for eels and for theory.
    """

    ELLIPSE = "ellipse"
    BOX = "box"
    TRANSETH = "transeth"
    VISCOUS = "viscous"


@dataclass(frozen=True)
class Ground:
    """What the ground is made of.

    Attributes:
        stiffness: k of Eq. 7 [N/m].
        damping: d of Eq. 7 [N s/m].
        mu_tangential: Friction coefficient along the body.
        mu_normal: Friction coefficient across the body.
        slip_speed: The smoothing: at this slip speed friction reaches 1/sqrt(2) of Coulomb's [m/s].
        law: How the ground resists slip.
        drag_tangential: c_t of the viscous law, a link's drag along the body [N s/m].
        drag_normal: c_n of the viscous law, a link's drag across the body [N s/m].
    """

    stiffness: float = 2000.0
    damping: float = 20.0
    mu_tangential: float = 0.05
    mu_normal: float = 0.5
    slip_speed: float = 0.01
    law: FrictionLaw = FrictionLaw.ELLIPSE
    drag_tangential: float = 1.0
    drag_normal: float = 10.0
