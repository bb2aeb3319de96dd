"""Rays against closed forms and against PyBullet's own ray casting."""

import math

import numpy as np
import pybullet
import pytest

from undulog.sim.physics.ranging import RayCaster
from undulog.sim.scenario.obstacles import Box, Cylinder, Wall

INF = math.inf


def cast(caster, origin, direction, **options):
    way = np.array(direction, dtype=float)[:, None]
    start = np.array(origin, dtype=float)[:, None]
    return float(caster.distance(start, way / np.linalg.norm(way), **options)[0])


@pytest.mark.parametrize("degrees", [0, 20, 45, 70])
def test_a_wall_seen_at_an_angle(degrees):
    caster = RayCaster([Wall((1.0, -5.0), (1.0, 5.0), thickness=0.1)], ground=False)
    angle = math.radians(degrees)
    distance = cast(caster, (0, 0, 0.1), (math.cos(angle), math.sin(angle), 0.0))
    assert distance == pytest.approx(0.95 / math.cos(angle), rel=1e-14)


def test_a_cylinder_off_the_line_of_sight():
    caster = RayCaster([Cylinder((2.0, 0.3), 0.5, 1.0)], ground=False)
    assert cast(caster, (0, 0, 0.1), (1, 0, 0)) == pytest.approx(2.0 - 0.4, rel=1e-14)
    assert cast(caster, (0, -0.3, 0.1), (1, 0, 0)) == INF
    assert cast(caster, (0, 0, 0.1), (-1, 0, 0)) == INF  # behind
    assert cast(caster, (2.1, 0.3, 0.1), (1, 0, 0)) == 0.0  # from inside


def test_over_the_top_and_onto_it():
    shapes = [Cylinder((2.0, 0.0), 0.5, 0.2), Box((5.0, 0.0), (1.0, 1.0), 0.3, 0.2)]
    caster = RayCaster(shapes, ground=False)
    assert cast(caster, (0, 0, 0.21), (1, 0, 0)) == INF
    assert cast(caster, (2.0, 0.1, 1.0), (0, 0, -1)) == pytest.approx(0.8)
    assert cast(caster, (5.0, 0.1, 1.0), (0, 0, -1)) == pytest.approx(0.8)
    assert cast(caster, (7.0, 0.1, 1.0), (0, 0, -1)) == INF
    # Over the front edge onto the top.
    assert cast(caster, (0, 0, 0.8), (2.0, 0.0, -0.6)) == pytest.approx(math.hypot(2.0, 0.6))


def test_the_ground():
    caster = RayCaster([], ground=True)
    assert cast(caster, (0, 0, 0.5), (1, 0, -1)) == pytest.approx(math.sqrt(0.5))
    assert cast(caster, (0, 0, 0.5), (1, 0, 0)) == INF
    assert cast(caster, (0, 0, 0.5), (1, 0, 1)) == INF
    assert cast(caster, (0, 0, -0.1), (0, 0, 1)) == 0.0
    assert cast(caster, (0, 0, 0.5), (1, 0, -1), ground=False) == INF
    assert cast(RayCaster([], ground=False), (0, 0, 0.5), (0, 0, -1)) == INF


def test_along_a_face_and_straight_up():
    caster = RayCaster([Box((1.0, 0.0), (1.0, 1.0), 0.0, 0.5)], ground=False)
    assert cast(caster, (0, 0.5000001, 0.1), (1, 0, 0)) == INF
    assert cast(caster, (0, 0.4999999, 0.1), (1, 0, 0)) == pytest.approx(0.5)
    assert cast(caster, (1.0, 0.0, 2.0), (0, 0, 1)) == INF
    assert cast(RayCaster([Cylinder((0, 0), 0.1)], ground=False), (0, 0, 2.0), (0, 0, 1)) == INF


@pytest.fixture
def foreign():
    """Distances in the same world by PyBullet."""
    client = pybullet.connect(pybullet.DIRECT)

    def build(obstacles):
        for shape in obstacles:
            if isinstance(shape, Cylinder):
                kind = {"shapeType": pybullet.GEOM_CYLINDER, "radius": shape.radius}
                kind["height"] = shape.height
                at, heading, height = shape.position, 0.0, shape.height
            else:
                box = shape.box if isinstance(shape, Wall) else shape
                half = [box.size[0] / 2, box.size[1] / 2, box.height / 2]
                kind = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
                at, heading, height = box.position, box.heading, box.height
            body = pybullet.createMultiBody(
                0.0,
                pybullet.createCollisionShape(**kind, physicsClientId=client),
                -1,
                (*at, height / 2),
                pybullet.getQuaternionFromEuler((0, 0, heading)),
                physicsClientId=client,
            )
            # Without bit 1 rays pass it.
            pybullet.setCollisionFilterGroupMask(body, -1, 1, 1, physicsClientId=client)
        ground = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[50, 50, 0.5], physicsClientId=client
        )
        pybullet.createMultiBody(0.0, ground, -1, (0, 0, -0.5), physicsClientId=client)

        def distance(origin, direction, longest):
            ends = origin + longest * direction
            hits = pybullet.rayTestBatch(origin.T.tolist(), ends.T.tolist(), physicsClientId=client)
            return np.array([hit[2] * longest if hit[0] >= 0 else INF for hit in hits])

        return distance

    yield build
    pybullet.disconnect(client)


@pytest.mark.parametrize("seed", range(5))
def test_random_worlds_against_pybullet(foreign, seed):
    random = np.random.default_rng(seed)

    def shape():
        at, height = tuple(random.uniform(-3, 3, 2)), random.uniform(0.05, 0.6)
        kind = random.integers(3)
        if kind == 0:
            return Cylinder(at, random.uniform(0.05, 0.4), height)
        if kind == 1:
            return Box(at, tuple(random.uniform(0.1, 1, 2)), random.uniform(-4, 4), height)
        end = tuple(np.add(at, random.uniform(-1, 1, 2)))
        return Wall(at, end, random.uniform(0.02, 0.2), height)

    obstacles = [shape() for _ in range(30)]
    caster = RayCaster(obstacles, ground=True)
    origin = np.vstack([random.uniform(-3, 3, (2, 600)), random.uniform(0.01, 0.8, 600)])
    direction = random.normal(size=(3, 600))
    direction[2] *= 0.2
    direction /= np.linalg.norm(direction, axis=0)
    ours = caster.distance(origin, direction)
    theirs = foreign(obstacles)(origin, direction, 20.0)
    outside = ours > 0.0  # what rays see from inside a shape is a matter of taste
    assert outside.sum() > 400
    ours, theirs = np.where(ours > 20.0, INF, ours)[outside], theirs[outside]
    hit = np.isfinite(ours)
    assert hit.sum() > 200
    np.testing.assert_array_equal(hit, np.isfinite(theirs))
    error = np.abs(ours[hit] - theirs[hit])
    # PyBullet finds hits on cylinders by iteration, and rounds edges by its collision margin.
    assert np.median(error) < 1e-12
    assert np.quantile(error, 0.98) < 2e-3
