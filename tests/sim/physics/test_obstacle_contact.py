"""Links against obstacles: closed forms, and what holds of any such law."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from undulog.sim.physics.obstacle_contact import obstacle_law
from undulog.sim.scenario.obstacles import Box, Cylinder, ObstacleMaterial, Wall

LENGTH, RADIUS, MASS, INERTIA = 0.06, 0.025, 0.1, 5e-5
STUFF = ObstacleMaterial(stiffness=5000.0, damping=20.0, mu=0.3, slip_speed=0.01)
FIELD = (
    Cylinder((0.1, 0.05), 0.08, 0.5),
    Box((-0.1, 0.0), (0.15, 0.1), 0.4, 0.5),
    Wall((0.0, -0.1), (0.2, -0.15), 0.03, 0.5),
)


def law(obstacles, material=STUFF, links=1, dt=0.0):
    sizes = np.full(links, RADIUS), np.full(links, LENGTH)
    masses = {"mass": np.full(links, MASS), "inertia": np.full(links, INERTIA)}
    return obstacle_law(obstacles, material, *sizes, **masses, dt=dt)


def about_z(angle):
    zero = np.zeros_like(angle)
    return np.array([zero, zero, np.sin(angle / 2), np.cos(angle / 2)])


def random_links(seed, links=400, tilted=True):
    """Links that lie and move anyhow among the obstacles."""
    random = np.random.default_rng(seed)
    position = np.vstack([random.uniform(-0.25, 0.25, (2, links)), np.full(links, 0.1)])
    quaternion = random.normal(size=(4, links))
    if not tilted:
        quaternion[:2] = 0.0
    quaternion /= np.linalg.norm(quaternion, axis=0)
    return position, quaternion, random.normal(size=(3, links)), random.normal(size=(3, links)) * 10


def test_at_a_distance_nothing_acts():
    contact = law(FIELD)(np.array([[2.0, 0, 0.025]]).T, about_z(np.zeros(1)), *np.ones((2, 3, 1)))
    assert (len(contact.link), contact.layers(1)) == (0, [])


@pytest.mark.parametrize("seed", range(5))
def test_what_is_out_of_reach_never_acts(seed):
    """Obstacles are left out by where links were before they moved; contacts are those of all."""
    random = np.random.default_rng(seed)
    scattered = [
        *(Cylinder(random.uniform(-2, 2, 2), random.uniform(0.02, 0.3), 0.5) for _ in range(20)),
        *(Box(random.uniform(-2, 2, 2), random.uniform(0.02, 0.5, 2), 0.4, 0.5) for _ in range(20)),
    ]
    all_of_them, way, left_out = law(scattered, links=3), 0.15, 0
    for _ in range(100):
        position, quaternion, *motion = random_links(random.integers(2**31), links=3)
        position[:2] += random.uniform(-2, 2, (2, 1))
        near = all_of_them.reachable(position, way)
        direction = random.uniform(-np.pi, np.pi, 3)
        position[:2] += way * random.uniform(0, 1, 3) * [np.cos(direction), np.sin(direction)]
        nearby = near(position, quaternion, *motion)
        for part, other in zip(nearby, all_of_them(position, quaternion, *motion), strict=True):
            np.testing.assert_array_equal(part, other)
        left_out += len(scattered) - sum(len(shape.height) for shape in near.shapes)
    assert left_out > 0.3 * 100 * len(scattered)


@pytest.mark.parametrize(
    ("velocity", "force"),
    # Moving on at 0.05 m/s; and away so fast that the damper would pull.
    [((0.05, 0.0, 0.0), -(5000 * 0.002 + 20 * 0.05)), ((-3.0, 1.0, 0.0), 0.0)],
)
def test_the_force_is_that_of_a_spring_and_damper_along_the_normal(velocity, force):
    # The front end of a link that points at a wall, 2 mm in.
    x = -0.01 - RADIUS - LENGTH / 2 + 0.002
    place, still = np.array([[x, 0.3, 0.025]]).T, np.zeros((3, 1))
    pushes = law([Wall((0.0, -1.0), (0.0, 1.0), 0.02)])
    contact = pushes(place, about_z(np.zeros(1)), np.array([velocity]).T, still)
    assert contact.depth == pytest.approx(0.002)
    np.testing.assert_allclose(contact.normal[:, 0], (-1, 0, 0), atol=1e-15)
    np.testing.assert_allclose(contact.force[:, 0], (force, 0, 0), atol=1e-9)
    np.testing.assert_allclose(contact.point[:, 0], (-0.01 + 0.002, 0.3, 0.025), atol=1e-12)


def test_a_link_beside_a_cylinder_is_pushed_off_and_held_by_friction():
    # Side by side, 1 mm in, sliding along at 1 m/s and rolling up and down at the contact.
    y = 0.08 + RADIUS - 0.001
    place, velocity, spin = np.array([[[0.01, y, 0.025]], [[1, 0, 0]], [[4, 0, 0]]]).mT
    contact = law([Cylinder((0.0, 0.0), 0.08)])(place, about_z(np.zeros(1)), velocity, spin)
    press = 5000 * 0.001
    # The contact is at y = -r on the link: v + w x (0, -r, 0) = (1, 0, -4 r).
    slip = np.array([1.0, 0.0, -4.0 * RADIUS])
    np.testing.assert_allclose(contact.velocity[:, 0], slip, atol=1e-12)
    expected = -0.3 * press * slip / math.hypot(*slip, 0.01) + np.array([0, press, 0])
    np.testing.assert_allclose(contact.force[:, 0], expected, rtol=1e-9)


def test_over_the_top_it_does_not_touch():
    def touching(height):
        place, pushes = np.array([[0.0, 0.09, 0.1]]).T, law([Cylinder((0.0, 0.0), 0.08, height)])
        return len(pushes(place, about_z(np.zeros(1)), *np.zeros((2, 3, 1))).link)

    assert (touching(0.1 - RADIUS + 1e-6), touching(0.1 - RADIUS - 1e-6)) == (1, 0)


def test_between_two_obstacles_both_push():
    away = 0.1 + RADIUS - 0.001
    pushes = law([Cylinder((0.0, side * away), 0.1) for side in (1, -1)], links=2)
    places = np.array([[0.0, 0.0, 0.025], [1.0, 0.0, 0.025]]).T
    contact = pushes(places, about_z(np.zeros(2)), *np.zeros((2, 3, 2)))
    assert contact.link.tolist() == [0, 0]
    np.testing.assert_allclose(contact.force.sum(axis=1), 0.0, atol=1e-12)
    layers = contact.layers(2)
    assert len(layers) == 2
    np.testing.assert_array_equal(sum(force for force, _ in layers)[:, 1], 0.0)
    np.testing.assert_allclose(sorted(force[1, 0] for force, _ in layers), (-5.0, 5.0))


@pytest.mark.parametrize("seed", range(3))
def test_the_normal_is_horizontal_and_leads_out_of_the_obstacle(seed):
    links = random_links(seed)
    contact = law(FIELD, links=400)(*links)
    assert len(contact.link) > 100
    np.testing.assert_allclose(np.linalg.norm(contact.normal, axis=0), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(contact.normal[2], 0.0)
    # Friction acts across the normal only, and never beyond mu times the normal force.
    press = (contact.force * contact.normal).sum(axis=0)
    assert (press >= 0.0).all()
    tangential = contact.force - press * contact.normal
    assert (np.linalg.norm(tangential, axis=0) <= 0.3 * press + 1e-12).all()
    # A step along the normals makes all contacts shallower by as much.
    for k in range(0, len(contact.link), 7):
        i = contact.link[k]
        alone = [values[:, i : i + 1].copy() for values in links]
        alone[0] += 1e-4 * contact.normal[:, k : k + 1]
        again = law(FIELD)(*alone)
        which = np.argmax((again.normal * contact.normal[:, k : k + 1]).sum(axis=0))
        assert again.depth[which] == pytest.approx(contact.depth[k] - 1e-4, abs=2e-6)


@pytest.mark.parametrize("seed", range(3))
def test_friction_and_damper_only_take(seed):
    contact = law(FIELD, links=400)(*random_links(seed))
    speed = (contact.velocity * contact.normal).sum(axis=0)
    press = (contact.force * contact.normal).sum(axis=0)
    slip = contact.velocity - speed * contact.normal
    assert ((contact.force * slip).sum(axis=0) <= 1e-12).all()
    stored = 5000.0 * contact.depth
    assert ((press - stored) * speed <= 1e-9).all()


@pytest.mark.parametrize("dt", [1e-3, 2.5e-4])
def test_friction_never_turns_the_slip_of_a_free_link_within_a_step(dt):
    links = random_links(7)
    contact, position = law(FIELD, links=400, dt=dt)(*links), links[0]
    friction = contact.force - (contact.force * contact.normal).sum(axis=0) * contact.normal
    arm = contact.point - position[:, contact.link]
    slip = contact.velocity - (contact.velocity * contact.normal).sum(axis=0) * contact.normal
    # A free ball of the link's mass and least moment, the bluntest body that there could be.
    turn = np.cross(np.cross(arm, friction, axis=0), arm, axis=0) / INERTIA
    after = slip + dt * (friction / MASS + turn)
    after -= (after * contact.normal).sum(axis=0) * contact.normal
    assert (np.linalg.norm(dt * friction, axis=0) > 0.02 * MASS).any()
    assert ((after * slip).sum(axis=0) >= -1e-12).all()


def test_the_bound_on_friction_goes_with_the_step():
    links = random_links(8)
    exact = law(FIELD, links=400)(*links)
    worst = []
    for dt in (1e-4, 1e-5, 1e-6, 1e-7):
        contact = law(FIELD, links=400, dt=dt)(*links)
        np.testing.assert_array_equal(contact.depth, exact.depth)
        worst.append(np.linalg.norm(contact.force - exact.force, axis=0).max())
    assert all(np.diff(worst) < 0.0)
    assert worst[-1] < 1e-4 * np.linalg.norm(exact.force, axis=0).max()


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.2])
def test_turning_the_world_turns_the_forces(angle):
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def turned(at):
        return tuple(turn[:2, :2] @ np.array(at))

    cylinder, box, wall = FIELD
    world = (
        dataclasses.replace(cylinder, position=turned(cylinder.position)),
        dataclasses.replace(box, position=turned(box.position), heading=box.heading + angle),
        dataclasses.replace(wall, start=turned(wall.start), end=turned(wall.end)),
    )
    position, quaternion, velocity, spin = random_links(5)
    spun = Rotation.from_rotvec((0, 0, angle)) * Rotation.from_quat(quaternion.T)
    before = law(FIELD, links=400)(position, quaternion, velocity, spin)
    after = law(world, links=400)(turn @ position, spun.as_quat().T, turn @ velocity, turn @ spin)
    np.testing.assert_array_equal(after.link, before.link)
    np.testing.assert_allclose(after.force, turn @ before.force, atol=1e-8)
    np.testing.assert_allclose(after.point, turn @ before.point, atol=1e-12)


class Block:
    """One link that slides without friction on a plane, stepped as the twin steps its body."""

    def __init__(self, at, angle, velocity, spin=0.0):
        self.position = np.array([[*at, 0.025]]).T
        self.angle = np.array([angle])
        self.velocity = np.array([[*velocity, 0.0]]).T
        self.spin = np.array([[0.0, 0.0, spin]]).T

    def contact(self, pushes):
        return pushes(self.position, about_z(self.angle), self.velocity, self.spin)

    def step(self, pushes, dt):
        contact = self.contact(pushes)
        arm = contact.point - self.position
        self.velocity = self.velocity + dt * contact.force.sum(axis=1)[:, None] / MASS
        self.spin[2] += dt * (arm[0] * contact.force[1] - arm[1] * contact.force[0]).sum() / INERTIA
        self.position = self.position + dt * self.velocity
        self.angle = self.angle + dt * self.spin[2]
        return contact

    def energy(self, pushes):
        depth = self.contact(pushes).depth
        moving = MASS * (self.velocity**2).sum() + INERTIA * self.spin[2, 0] ** 2
        return (moving + 5000.0 * (depth**2).sum()) / 2


@pytest.mark.parametrize("damping", [0.0, 5.0, 20.0])
def test_a_head_on_bounce_is_that_of_a_damped_oscillator(damping):
    # m d'' + c d' + k d = 0 until k d + c d' = 0: then the wall lets go.
    k, v = 5000.0, 0.3
    decay, omega = damping / (2 * MASS), math.sqrt(k / MASS - (damping / (2 * MASS)) ** 2)
    released = math.atan2(damping * omega, damping * decay - k) / omega  # in (0, pi / omega]
    rate = math.cos(omega * released) - decay / omega * math.sin(omega * released)
    rebound = -v * math.exp(-decay * released) * rate

    pushes = law([Wall((0.0, -1.0), (0.0, 1.0), 0.02)], dataclasses.replace(STUFF, damping=damping))
    block = Block((-0.07, 0.0), 0.0, (v, 0.0))
    touched = 0
    for _ in range(3000):
        touched += len(block.step(pushes, 2e-5).link) > 0
    assert touched * 2e-5 >= released * 0.99
    assert -block.velocity[0, 0] == pytest.approx(rebound, rel=2e-3)
    assert abs(block.velocity[1, 0]) < 1e-15
    assert abs(block.spin[2, 0]) < 1e-13


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]
)
def test_without_damper_and_friction_a_tumbling_block_keeps_its_energy(seed):
    random = np.random.default_rng(seed)
    room = [
        Wall((-0.15, -0.15), (0.15, -0.15)),
        Wall((0.15, -0.15), (0.15, 0.15)),
        Wall((0.15, 0.15), (-0.15, 0.15)),
        Wall((-0.15, 0.15), (-0.15, -0.15)),
        Cylinder((0.05, 0.06), 0.02),
        Box((-0.06, -0.05), (0.03, 0.05), 0.5),
    ]
    pushes = law(room, dataclasses.replace(STUFF, damping=0.0, mu=0.0))
    angle = random.uniform(0, 6.0)
    block = Block((0.02, -0.02), angle, (math.cos(angle), math.sin(angle)), 5.0)
    start, bounces, before = block.energy(pushes), 0, False
    for _ in range(6000):
        touching = len(block.step(pushes, 1e-4).link) > 0
        bounces += touching and not before
        before = touching
    assert bounces > 5
    assert abs(block.position[:2]).max() < 0.15
    assert block.energy(pushes) == pytest.approx(start, rel=0.01)


def test_a_block_that_slides_along_a_wall_is_slowed_by_mu_times_the_press():
    # Held against the wall with 2 N across: it slides v^2 / (2 mu F / m) far.
    pushes = law([Cylinder((0.0, 100.0), 100.0)])
    held = 2.0
    block = Block((0.0, -RADIUS + held / 5000.0), 0.0, (0.2, 0.0))
    block.spin[:] = 0.0
    start = block.position[0, 0]
    for _ in range(2000):
        block.velocity[1] += 1e-4 * held / MASS
        block.step(pushes, 1e-4)
        block.spin[:], block.angle = 0.0, np.zeros(1)  # kept from turning
    v, eps, brake = 0.2, 0.01, 0.3 * held / MASS
    smoothed = (v * math.hypot(v, eps) + eps**2 * math.asinh(v / eps)) / (2 * brake)
    assert block.position[0, 0] - start == pytest.approx(smoothed, rel=2e-2)
