"""A world whose parameters are hidden, a session of it, and the twin fitted to that."""

import numpy as np
from scipy.signal import lfilter

import undulog as front
from support import twin_chains
from undulog.capture import Session, SessionWriter


def room_for(
    folder,
    joints,
    duration,
    hidden,
    *,
    noise=0.005,
    gait=(0.4, 1.0),
    seed=2,
    stall=0.3,
    rate_hz=1000,
):
    """Write a nominal world, and record a session of one with other parameters.

    The session is of a twin at the physics rate ``rate_hz``; the nominal one has 1 kHz.
    The checks whether a twin fits have a level of 5 %: one noise in twenty is taken for a misfit.
    """
    servo = {"stall_torque": stall, "gear_stiffness": 12.0, "gear_damping": 0.008}
    robot = twin_chains.chain(joints, planes=["horizontal"], **servo)
    noted = robot.replace("[defaults.servo]", "[defaults.servo]  # of the data sheet")
    (folder / "robot.toml").write_text(noted)
    amplitude, frequency_hz = gait
    world = twin_chains.wave(
        robot="robot.toml",
        duration_s=duration,
        settle_s=1.5,
        gait={"ramp_s": 0.5},
        horizontal={"amplitude": amplitude, "frequency_hz": frequency_hz, "lag": 1.0},
        noise={"position": noise},
    )
    (folder / "nominal.toml").write_text(world)
    finer = f"physics_rate_hz = {rate_hz}\n" + world
    (folder / "hidden.toml").write_text(finer + hidden)
    words = ["sim", "run", str(folder / "hidden.toml"), "-o", str(folder / "run.mcap")]
    assert front.run([*words, "--seed", str(seed), "--kernels", "numba"]) == 0
    return folder


def fitted(room, report_of, *words, source="run.mcap"):
    report = report_of("sim", "fit", room / source, "--on", f"twin:{room / 'nominal.toml'}", *words)
    return report, {
        (parameter["name"], parameter["module"]): parameter for parameter in report["parameters"]
    }


def rewritten(source, target, change):
    """Write commands and states of a session again; ``change`` returns times and rows of states."""
    with Session.open(source) as session:
        commands, states = (session.joints(t) for t in ("/joint_commands", "/joint_states"))
        robot = session.robot
    epoch_ns = int(commands.t_ns[0][0])
    with SessionWriter(target, session_id=target.stem, epoch_ns=epoch_ns, robot=robot) as writer:
        for topic, signals in (("/joint_commands", commands), ("/joint_states", states)):
            channel = writer.joint_state(topic, signals.names, unit="rad")
            t_ns, rows = signals.t_ns[0], np.array(signals.values).T.copy()
            if signals is states:
                t_ns, rows = change(t_ns, rows)
            for stamp, row in zip(t_ns.tolist(), rows, strict=True):
                channel.write(stamp, row)


def restamped(source, target, stamps, *, noise=0.0, seed=0):
    """Write a session again with other stamps: ``stamps`` of a generator and times [ns].

    The rows depend on noise and seed only.
    """
    of_rows, of_stamps = (np.random.default_rng([seed, k]) for k in range(2))
    with Session.open(source) as session:
        topics = {t: session.joints(t) for t in ("/joint_commands", "/joint_states")}
        robot = session.robot
    epoch_ns = int(topics["/joint_commands"].t_ns[0][0])
    with SessionWriter(target, session_id=target.stem, epoch_ns=epoch_ns, robot=robot) as writer:
        for topic, signals in topics.items():
            channel = writer.joint_state(topic, signals.names, unit="rad")
            rows = np.array(signals.values).T.copy()
            if topic == "/joint_states":
                rows += noise * of_rows.standard_normal(rows.shape)
            for t_ns, row in zip(stamps(of_stamps, signals.t_ns[0]).tolist(), rows, strict=True):
                channel.write(t_ns, row)
    return target


def exact(_random, t_ns):
    """Stamps as they were."""
    return t_ns


def rounded(random, t_ns):
    """Stamps that went through seconds in double precision: off by up to 114 ns."""
    return t_ns + random.integers(-114, 115, t_ns.size)


def jittered(random, t_ns):
    """Stamps off by 0.4 ms (standard deviation)."""
    return t_ns + np.round(4e5 * random.standard_normal(t_ns.size)).astype(np.int64)


def colored(random, rho, *shape):
    """AR(1) noise of variance one, shape (..., n)."""
    white = random.standard_normal((*shape[:-1], shape[-1] + 500))
    return np.sqrt(1 - rho**2) * lfilter([1.0], [1.0, -rho], white)[..., 500:]
