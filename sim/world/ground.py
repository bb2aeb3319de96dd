"""What the ground is made of."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FrictionLaw(StrEnum):
    """How the two friction coefficients combine when a link slips obliquely.

    ``ellipse``: greatest dissipation on the ellipse (F_t/mu_t)^2 + (F_n/mu_n)^2 = N^2, the
    convex anisotropic Coulomb law (Goyal, Ruina & Papadopoulos, Wear 143, 1991).
    ``box``: each axis on its own, F_i = mu_i N sgn(v_i), the literal reading of Meister,
    Stepanenko & Kernbach 2011.
    ``transeth``: F_i = mu_i N v_i / |v| (Transeth, Leine, Glocker & Pettersen, IEEE Trans.
    Robotics 24, 2008).
    """

    ELLIPSE = "ellipse"
    BOX = "box"
    TRANSETH = "transeth"


@dataclass(frozen=True)
class Ground:
    """What the ground is made of.

    Attributes:
        stiffness: k of Eq. 7 [N/m].
        damping: d of Eq. 7 [N s/m].
        mu_tangential: Friction coefficient along the body.
        mu_normal: Friction coefficient across the body.
        slip_speed: The smoothing: at this slip speed friction reaches 1/sqrt(2) of Coulomb's [m/s].
        law: How the two coefficients combine.
    """

    stiffness: float = 2000.0
    damping: float = 20.0
    mu_tangential: float = 0.05
    mu_normal: float = 0.5
    slip_speed: float = 0.01
    law: FrictionLaw = FrictionLaw.ELLIPSE
