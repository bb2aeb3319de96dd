"""The servos: DC motors that drive the joints through series-elastic gears.

The gear's spring sits between rotor and joint, so a weak motor yields to what its neighbours and
the ground do to the joint: this is where the response of a joint comes to depend on its place in
the chain. Equations, per joint (rotor angle th and speed om referred to the joint)::

    u      = clip(Kp (q_ref - q), -1, 1)            duty
    i      = (u V - Kt om) / R                      winding current, Ke = Kt
    t_g    = k_g D(th - q) + c_g (om - q')          gear torque, acts on the joint
    Jm om' = Kt i - b om - t_c tanh(om / 0.05) - t_g

D(x) = x - clip(x, -B/2, B/2) is the dead zone of a gear with the play B between its flanks (Nordin
and Gutman, Automatica 38, 2002): there the spring is slack and only the damper acts, the grease.

The smooth friction t_c tanh(om / 0.05) creeps: it has no rest. With a static friction t_s a rotor
does rest, its speed exactly zero, until t_s is overcome; moving, its friction falls with speed
(Stribeck 1902; Bo and Pavelescu, Wear 82, 1982)::

    t_m = t_c + (t_s - t_c) exp(-(om / v_s)^2)
    t_f = clip(Jm om / dt + Kt i - b om - t_g, -t_m, t_m)

in place of t_c tanh(om / 0.05). Within its bound t_f is what stops the rotor in this very step:
Coulomb's law in its time-stepping form (Moreau 1988), which neither creeps nor chatters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.robot.model import Servo

COULOMB_SPEED = 0.05
"""Rotor speed at which Coulomb friction is smoothed [rad/s]."""


class Rotors(NamedTuple):
    """State of all rotors, referred to their joints.

    Attributes:
        angle: th [rad], shape (m,).
        speed: om [rad/s], shape (m,).
    """

    angle: FloatArray
    speed: FloatArray


class Drive(NamedTuple):
    """What the servos do at one instant.

    Attributes:
        voltage: Motor voltage u V [V], shape (m,).
        current: Winding current i [A], shape (m,).
        torque: Gear torque t_g on the joint [N m], shape (m,).
    """

    voltage: FloatArray
    current: FloatArray
    torque: FloatArray


class Servos:
    """The servos of all joints, as arrays.

    Attributes:
        table: All parameters of :class:`.Servo`, SI, in the order of the attributes
            below, shape (12, m).
        supply, resistance, torque_constant, gain, inertia, viscous, coulomb, gear_stiffness,
            gear_damping, play, static, stribeck: Its rows, each of shape (m,).
        resting: Indices of the servos that have static friction, shape (r,).
        losses: Coefficients of the losses in winding, bearing, Coulomb friction and gear's damper:
            resistance, viscous, coulomb and gear_damping again, shape (4, m).
    """

    def __init__(self, servos: Sequence[Servo]) -> None:
        """Gather the parameters.

        Args:
            servos: One a joint, head to tail.
        """
        parameters = [
            (
                *(
                    servo.supply_v,
                    servo.resistance_ohm,
                    servo.torque_constant,
                    servo.proportional_gain,
                ),
                *(servo.rotor_inertia, servo.viscous_friction, servo.coulomb_friction),
                *(servo.gear_stiffness, servo.gear_damping, servo.backlash),
                *(servo.static_friction, servo.stribeck_speed),
            )
            for servo in servos
        ]
        self.table = frozen(np.array(parameters, dtype=np.float64).reshape(-1, 12).T.copy())
        self.supply, self.resistance, self.torque_constant, self.gain = self.table[:4]
        self.inertia, self.viscous, self.coulomb = self.table[4:7]
        self.gear_stiffness, self.gear_damping, self.play = self.table[7:10]
        self.static, self.stribeck = self.table[10:]
        self.losses = frozen(
            np.array([self.resistance, self.viscous, self.coulomb, self.gear_damping])
        )
        self._tight = not self.play.any()
        self.resting = frozen(np.flatnonzero(self.static))
        self._slope = self.supply * self.gain  # of the voltage over the error, before it saturates

    def current(
        self, voltage: FloatArray, speed: FloatArray, out: FloatArray | None = None
    ) -> FloatArray:
        """Winding current i = (u V - Kt om)/R.

        Args:
            voltage: u V [V], shape (..., m).
            speed: Rotor speed om [rad/s], shape (..., m).
            out: Where the result goes; a new array by default.

        Returns:
            Current [A], shape (..., m).
        """
        return np.divide(voltage - self.torque_constant * speed, self.resistance, out=out)

    def drive(
        self,
        reference: FloatArray,
        angle: FloatArray,
        rate: FloatArray,
        rotors: Rotors,
        out: Drive | None = None,
    ) -> Drive:
        """What the servos do, given commands and state.

        Args:
            reference: Commanded joint angles q_ref [rad], shape (m,).
            angle: Joint angles q [rad], shape (m,).
            rate: Joint rates q' [rad/s], shape (m,).
            out: Where the result goes; new arrays by default.
        """
        into_voltage, into_current, into_torque = out or (None, None, None)
        voltage = _clip(self._slope * (reference - angle), self.supply, out=into_voltage)
        twist, twist_rate = self.twist(angle, rotors.angle), rotors.speed - rate
        torque = np.add(
            self.gear_stiffness * twist, self.gear_damping * twist_rate, out=into_torque
        )
        return Drive(voltage, self.current(voltage, rotors.speed, out=into_current), torque)

    def twist(self, angle: FloatArray, rotor: FloatArray) -> FloatArray:
        """How far the gears' springs are wound up, D(th - q).

        Args:
            angle: Joint angles q [rad], shape (..., m).
            rotor: Rotor angles th [rad], shape (..., m).

        Returns:
            [rad], 0 within the play, shape (..., m).
        """
        between = rotor - angle
        if self._tight:
            return between
        return between - _clip(between, 0.5 * self.play)

    def friction(self, rotors: Rotors, drive: Drive, dt: float) -> FloatArray:
        """Coulomb friction of the rotors during a step, or what holds them at rest.

        Args:
            rotors: Their state at the step's start, each field of shape (..., m).
            drive: What the servos do during the step, each field of shape (..., m).
            dt: Step [s].

        Returns:
            Torque against the motion [N m], shape (..., m).
        """
        torque = self.coulomb * np.tanh(rotors.speed / COULOMB_SPEED)
        if self.resting.size:
            some = self.resting
            most = self._breakaway(rotors.speed[..., some])
            torque[..., some] = _clip(self._stopping(rotors, drive, dt), most)
        return torque

    def _breakaway(self, speed: FloatArray) -> FloatArray:
        """Most friction that resting servos have, t_m at their speeds, shape (..., r)."""
        some = self.resting
        above = self.static[some] - self.coulomb[some]
        return self.coulomb[some] + above * np.exp(-((speed / self.stribeck[some]) ** 2))

    def _stopping(self, rotors: Rotors, drive: Drive, dt: float) -> FloatArray:
        """Torque that stops the rotors of the resting servos in one step, shape (..., r)."""
        some = self.resting
        speed = rotors.speed[..., some]
        torque = self.torque_constant[some] * drive.current[..., some] - self.viscous[some] * speed
        return self.inertia[some] * speed / dt + (torque - drive.torque[..., some])

    def advance(self, rotors: Rotors, drive: Drive, dt: float, out: Rotors | None = None) -> Rotors:
        """The rotors one step later, by the semi-implicit Euler rule that the body follows too.

        Args:
            drive: What the servos do during the step.
            dt: Step [s].
            out: Where the result goes; new arrays by default.
        """
        into_angle, into_speed = out or (None, None)
        torque = self.torque_constant * drive.current - self.viscous * rotors.speed
        torque -= self.friction(rotors, drive, dt) + drive.torque
        speed = np.add(rotors.speed, dt * torque / self.inertia, out=into_speed)
        if self.resting.size:
            # Exactly zero, which rounding would miss.
            held = np.abs(self._stopping(rotors, drive, dt)) <= self._breakaway(
                rotors.speed[self.resting]
            )
            speed[self.resting[held]] = 0.0
        return Rotors(np.add(rotors.angle, dt * speed, out=into_angle), speed)


def _clip(values: FloatArray, bound: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """``numpy.clip`` to +-bound; that function costs thrice as much on short arrays."""
    return np.minimum(np.maximum(values, -bound), bound, out=out)
