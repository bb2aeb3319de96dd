"""The safety gate: one state machine for everything that is driven over a bus.

::

    reading the pose -> approach -> run -> done
            |              |         |
            |              +-> hold <-> ending -> done
            +-> refused

It decides once a control tick what is sent. Until the pose of every joint is known it sends
nothing; then it ramps to the first pose, then lets the gait through, cut to what the robot may do
(:mod:`.limits`). A fault or a request to stop leads to the ending that the robot's file
names. While the bus is silent (:mod:`.feedback`) nothing is sent, and the servos hold; the
ending begins when a joint is received again. It opens nothing and never blocks.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.robot.model import OnFault

from ..gait.contract import CONTROL_RATE_HZ, Gait, GaitTick
from .feedback import CurrentLimiter, Silence, Watch
from .limits import Clamp, Clamped, EndingRamp, GateLimits, Ramp, why_not_from
from .outcome import (
    MUTE,
    DriveEnding,
    FaultKind,
    GateEvent,
    GateFault,
    GateInput,
    GatePhase,
    GateStep,
    JointStatus,
    Outcome,
)

POSE_S = 2.0
"""So long the gate waits for the pose of every joint [s]."""
HOLD_S = 10.0
"""So long the joints are held while the bus is silent [s]; then the drive ends without a ramp."""
_PERIOD_S = 1.0 / CONTROL_RATE_HZ


class Gate:
    """The state machine, stepped once a tick; see the module.

    Attributes:
        outcome: How it ended; None until it has.
        gait_error: What the gait raised, if it did; to be raised when the robot is at rest.
        run_from: The tick at which the gait began; None before.
        run_ticks: Ticks that the gait commanded.
        run_s: The gait's time [s].
        silence: Whether the bus is silent.
        held_ticks: Ticks in which nothing was sent as the bus was silent, those left out among
            them.
    """

    def __init__(
        self,
        gait: Gait,
        limits: GateLimits,
        *,
        duration_s: float,
        place: str,
        listen_s: float = 0.0,
    ) -> None:
        """Begin by reading the pose.

        Args:
            limits: Limits of the robot.
            duration_s: Time of the gait's last tick.
            listen_s: So long the bus is listened to at least before anything is sent, to see whose
                it is and to measure its reply interval [s]; 0: it is the robot's, which waits for
                each command, so that no command can be held up.
        """
        self.phase = GatePhase.POSE
        self.outcome: Outcome | None = None
        self.gait_error: Exception | None = None
        self.run_from: int | None = None
        self.run_ticks = 0
        self.run_s = 0.0
        self.silence = Silence()
        self.held_ticks = 0
        self._silent_ticks = 0  # those of the silence that were counted by then
        self._was_received = False  # in the tick before this one, while holding
        self._gait, self._limits, self._place = gait, limits, place
        self._listen_s = listen_s
        self._last = round(duration_s * CONTROL_RATE_HZ)
        self._watch, self._yielding = Watch(limits), CurrentLimiter(limits.current)
        self._first: GaitTick | None = None
        self._clamp: Clamp | None = None
        self._way: Ramp | EndingRamp | None = None
        self._progress_s = 0.0
        self._tick: int | None = None  # the last one in which something was sent
        self._reported: GateFault | None = None
        self._logged: set[str] = set()
        self._remarks: list[GateEvent] = []

    @property
    def done(self) -> bool:
        """Whether nothing is sent any more."""
        return self.phase is GatePhase.DONE

    @property
    def cuts(self) -> dict[str, int]:
        """How often commands of single joints were changed, by why."""
        return dict(self._clamp.cuts) if self._clamp is not None else {}

    def step(
        self, tick: int, inputs: GateInput, stop: str = "", *, at_once: bool = False
    ) -> GateStep:
        """Return the command of a tick.

        Args:
            tick: Number of the control tick, from 0; never less than in the call before.
            stop: Why it is to stop, one sentence; empty: go on.
            at_once: Whether to stop without an ending.

        Returns:
            What to do; nothing more after the phase is done.

        Raises:
            SourceError: If the pose isn't known in time, or is no pose to start from.
            UsageError: If another robot is there.
        """
        self._remarks = []
        if self.done:
            return self._quiet()
        if not tick:
            self._remark("info", f"gate: {GatePhase.POSE}")
        self.silence.tick(tick, received=inputs.received, expected=inputs.expected)
        clamp = self._clamp or self._begin(tick, inputs, stop)
        if clamp is None:
            return self._quiet()
        self._log_skipped(tick, inputs.late_s)
        self._follow(tick, inputs, clamp, stop, at_once=at_once)
        if self.phase in {GatePhase.DONE, GatePhase.HOLD}:
            return self._quiet()
        requested, gait = self._requested(tick, inputs, clamp)
        pulled = self._yielding.apply(requested, inputs.status.angle, inputs.status.current)
        given = clamp.apply(pulled, inputs.bounds)
        self._log_changes(given)
        phase = self.phase
        self._end_in_time()
        return GateStep(phase, given.command, requested, gait, tuple(self._remarks))

    def report(self, fault: GateFault) -> None:
        """Something beside the robot went wrong: the next step begins the ending."""
        self._reported = fault

    def lost(self, why: str) -> None:
        """The bus can't be used any more: nothing more is sent."""
        if self.outcome is None or self.outcome.how is not DriveEnding.FAULT:
            self.outcome = Outcome(
                DriveEnding.FAULT, why, "nothing more was sent", GateFault(FaultKind.BUS, why)
            )
        self.phase = GatePhase.DONE

    # -- reading the pose ------------------------------------------------------------------

    def _begin(self, tick: int, inputs: GateInput, stop: str) -> Clamp | None:
        """Start from the pose, once it is known; None while it isn't."""
        waited_s = tick / CONTROL_RATE_HZ
        if (trouble := inputs.trouble or self._reported) is not None:
            raise SourceError(self._place, f"no command was sent: {trouble.text}")
        if stop:
            self.outcome = Outcome(DriveEnding.STOPPED, stop, "no command was sent")
            self.phase = GatePhase.DONE
            return None
        if waited_s < self._listen_s:
            return None
        if self._listen_s and inputs.another_robot is not None:
            raise UsageError(f"{self._place}: no command was sent: {inputs.another_robot}")
        angle, limits = inputs.status.angle, self._limits
        measured = not self._listen_s or self.silence.measure()
        if (np.isnan(angle).any() or not measured) and waited_s < POSE_S:
            return None
        if (why := why_not_from(angle, limits, waited_s)) is not None:
            raise SourceError(self._place, f"no command was sent: {why}")
        if not measured:
            why = f"too few reports of joint angles in {waited_s:.2g} s to supervise a drive"
            raise SourceError(self._place, f"no command was sent: {why}")
        clamp = self._clamp = Clamp(limits, angle, _PERIOD_S)
        first = self._first = self._gait.step(0.0, inputs.readings)
        target = np.clip(first.command, limits.lower, limits.upper)
        target = np.where(np.isfinite(target), target, clamp.last)
        far = np.abs(target - clamp.last)
        if (far <= limits.ramp_rate / CONTROL_RATE_HZ).all():
            self._run(tick)
            return clamp
        self._way, self._progress_s = Ramp(clamp.last, target, limits.ramp_rate), 0.0
        joint = int(np.argmax(far))
        self._become(
            GatePhase.APPROACH,
            f"{self._way.duration_s:.2g} s to the first pose, {limits.joint_names[joint]} has the "
            f"longest way, from {clamp.last[joint]:.3f} to {target[joint]:.3f} rad",
        )
        return clamp

    # -- what is wanted --------------------------------------------------------------------

    def _requested(
        self, tick: int, inputs: GateInput, clamp: Clamp
    ) -> tuple[FloatArray, GaitTick | None]:
        """Return the requested command of the phase, before limits."""
        if self.phase is not GatePhase.RUN and self._way is not None:
            self._progress_s += _PERIOD_S  # also where it is late: no jump
            if self.phase is GatePhase.ENDING or self._progress_s < self._way.duration_s:
                return self._way.at(self._progress_s), None
            self._run(tick)
        self.run_s = min(tick - (self.run_from or 0), self._last) / CONTROL_RATE_HZ
        self.run_ticks += 1
        stated, self._first = self._first, None
        try:
            stated = stated or self._gait.step(self.run_s, inputs.readings)
        except Exception as error:  # noqa: BLE001 (whatever it is, the joints come to rest)
            self.gait_error = error
            text = f"the gait failed: {type(error).__name__}: {error}"
            self.report(GateFault(FaultKind.GAIT, text))
            return clamp.last, None
        return stated.command, stated

    def _end_in_time(self) -> None:
        """End the drive if the last command was the final one."""
        if self.phase is GatePhase.RUN and self.run_s * CONTROL_RATE_HZ >= self._last - 1e-6:
            self.outcome = Outcome(DriveEnding.COMPLETE, "", "the servos hold their last commands")
            self._become(GatePhase.DONE)
            return
        way = self._way
        if (
            self.phase is GatePhase.ENDING
            and way is not None
            and self._progress_s >= way.duration_s
        ):
            self._become(GatePhase.DONE)

    def _run(self, tick: int) -> None:
        self.run_from = tick
        self._become(GatePhase.RUN)

    # -- what goes wrong -------------------------------------------------------------------

    def _follow(
        self, tick: int, inputs: GateInput, clamp: Clamp, stop: str, *, at_once: bool
    ) -> None:
        """Change the phase on a fault or a stop request."""
        fault = self._trouble(tick, inputs, clamp)
        if self.phase is GatePhase.HOLD and (fault is None or fault.kind not in MUTE):
            self._go_on_holding(clamp, inputs.status, at_once=at_once)
            return
        ending = self.phase is GatePhase.ENDING or self.silence.silent
        if fault is not None and (not ending or fault.kind in MUTE):
            self._fail(fault, clamp, inputs.status)
            return
        if self.silence.silent:
            self._fail(self._silent(tick), clamp, inputs.status)
            return
        if fault is not None and f"{fault.kind} {fault.joint}" not in self._logged:
            self._logged.add(f"{fault.kind} {fault.joint}")
            self._remark("error", f"fault while ending: {fault.text}")
        if at_once:
            self._halt(f"{stop}, twice")
        elif stop and self.phase is not GatePhase.ENDING:
            self.outcome = Outcome(DriveEnding.STOPPED, stop, "")
            self._end(clamp, inputs.status)

    def _trouble(self, tick: int, inputs: GateInput, clamp: Clamp) -> GateFault | None:
        if inputs.trouble is not None or self._reported is not None:
            return inputs.trouble or self._reported
        if inputs.late_s > self._limits.late_s:
            late_s, most_s = inputs.late_s, self._limits.late_s
            text = f"a control tick was {late_s:.2g} s late, more than {most_s:g} s"
            return GateFault(FaultKind.LATE, text, "", late_s, most_s)
        return self._watch.look(tick / CONTROL_RATE_HZ, inputs.status, clamp.last)

    def _fail(self, fault: GateFault, clamp: Clamp, status: JointStatus) -> None:
        self._logged.add(f"{fault.kind} {fault.joint}")
        self._remark("error", f"fault: {fault.text}")
        if self.outcome is None or self.outcome.how is DriveEnding.STOPPED:
            self.outcome = Outcome(DriveEnding.FAULT, fault.text, "", fault)
        if fault.kind in MUTE:
            self._halt(self.outcome.why)
        elif fault.kind is FaultKind.SILENT:
            self.held_ticks, self._silent_ticks = self.held_ticks + 1, self.silence.ticks
            self._was_received = False
            self._become(GatePhase.HOLD, "nothing is sent until a joint is received")
        else:
            self._end(clamp, status)

    def _silent(self, tick: int) -> GateFault:
        """Nothing was received for too long."""
        silence = self.silence
        silent_s, limit_s = silence.ticks * _PERIOD_S, silence.limit * _PERIOD_S
        interval_s = (silence.interval or 0) * _PERIOD_S
        text = (
            f"the bus was silent: no joint was received for {silence.ticks} control ticks "
            f"({silent_s:.3g} s), at a reply interval of {interval_s:.3g} s"
        )
        since_s = tick * _PERIOD_S - silent_s
        return GateFault(FaultKind.SILENT, text, "", silent_s, limit_s, since_s)

    def _go_on_holding(self, clamp: Clamp, status: JointStatus, *, at_once: bool) -> None:
        """Hold until a joint is received, then end; not after a timeout or a second stop request.

        The ending begins one control tick later: what the stall held up arrives as the bus comes
        back, and the first command of the ending doesn't join it.
        """
        if not self.silence.silent:
            if self._was_received:
                self._end(clamp, status)
            else:
                self._was_received = True
                self.held_ticks += 1
                self._remark("info", "gate: a joint was received again")
            return
        self._was_received = False
        self.held_ticks += self.silence.ticks - self._silent_ticks
        self._silent_ticks = self.silence.ticks
        if at_once or self.silence.ticks >= HOLD_S * CONTROL_RATE_HZ:
            self._halt("" if self.outcome is None else self.outcome.why)

    def _end(self, clamp: Clamp, status: JointStatus) -> None:
        """Begin the ending that the robot's file names."""
        ending = EndingRamp(self._limits, clamp.last, status)
        self._way, self._progress_s = ending, 0.0
        if self._limits.on_fault is OnFault.HOLD:
            how = "the joints were held where they were"
        else:
            how = f"the joints were brought straight within {ending.duration_s:.2g} s"
        if self.held_ticks:
            how = f"the servos held for {self.held_ticks / CONTROL_RATE_HZ:.2g} s, then {how}"
        if self.outcome is not None:
            self.outcome = dataclasses.replace(self.outcome, ended=how)
            self._become(GatePhase.ENDING, f"{self.outcome.why}; {self._limits.on_fault}")

    def _halt(self, why: str) -> None:
        """Send nothing from here on."""
        ended = "nothing more was sent; the servos hold their last commands"
        if self.outcome is not None and self.outcome.how is DriveEnding.FAULT:
            self.outcome = dataclasses.replace(self.outcome, ended=ended)
        else:
            self.outcome = Outcome(DriveEnding.STOPPED, why, ended)
        self._become(GatePhase.DONE, "nothing is sent any more")

    # -- telling ---------------------------------------------------------------------------

    def _log_skipped(self, tick: int, late_s: float) -> None:
        """Log skipped ticks; a ramp continues where it was."""
        before, self._tick = self._tick, tick
        left_out = 0 if before is None else tick - before - 1
        if left_out > 0:
            many = f"{left_out} control ticks were" if left_out > 1 else "a control tick was"
            of_gait = f", {left_out / CONTROL_RATE_HZ:g} s of the gait" * (
                self.phase is GatePhase.RUN
            )
            self._remark("warn", f"gate: {late_s:.3f} s late, {many} left out{of_gait}")

    def _become(self, phase: GatePhase, detail: str = "") -> None:
        self.phase = phase
        self._remark("info", f"gate: {phase}" + (f", {detail}" if detail else ""))

    def _remark(self, level: str, text: str) -> None:
        self._remarks.append(GateEvent(level, text))

    def _quiet(self) -> GateStep:
        return GateStep(self.phase, None, None, None, tuple(self._remarks))

    def _log_changes(self, given: Clamped) -> None:
        """Log once for each joint what the gate changes."""
        limits, names = self._limits, self._limits.joint_names
        reasons = (
            ("cut", given.by_position, "command cut to the limits of the joint"),
            ("rate", given.by_rate, "command held back to {rate:g} rad/s"),
            ("reply", given.unconfirmed, "command held back until a reply confirms those before"),
            ("nan", given.not_finite, "command is no number; the one before is held"),
            (
                "yields",
                self._yielding.yields,
                "draws more than {current:g} A: its command gives way",
            ),
        )
        for key, joints, text in reasons:
            for i in np.flatnonzero(joints).tolist():
                if f"{key} {names[i]}" not in self._logged:
                    self._logged.add(f"{key} {names[i]}")
                    stated = text.format(rate=limits.rate[i], current=limits.current[i])
                    self._remark("warn", f"gate: {names[i]}: {stated}")
