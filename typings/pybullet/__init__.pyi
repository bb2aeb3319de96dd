"""The few functions of PyBullet that undulog uses (the package has no types of its own)."""

# ruff: noqa: N802 - the names are the package's

from collections.abc import Sequence

DIRECT: int
JOINT_REVOLUTE: int
VELOCITY_CONTROL: int
TORQUE_CONTROL: int
WORLD_FRAME: int

_Vector = tuple[float, ...]

def connect(method: int, key: int = ..., options: str = ...) -> int: ...
def disconnect(physicsClientId: int = ...) -> None: ...
def createMultiBody(
    *,
    baseMass: float = ...,
    baseCollisionShapeIndex: int = ...,
    baseVisualShapeIndex: int = ...,
    basePosition: Sequence[float] = ...,
    baseOrientation: Sequence[float] = ...,
    linkMasses: Sequence[float] = ...,
    linkCollisionShapeIndices: Sequence[int] = ...,
    linkVisualShapeIndices: Sequence[int] = ...,
    linkPositions: Sequence[Sequence[float]] = ...,
    linkOrientations: Sequence[Sequence[float]] = ...,
    linkInertialFramePositions: Sequence[Sequence[float]] = ...,
    linkInertialFrameOrientations: Sequence[Sequence[float]] = ...,
    linkParentIndices: Sequence[int] = ...,
    linkJointTypes: Sequence[int] = ...,
    linkJointAxis: Sequence[Sequence[float]] = ...,
    physicsClientId: int = ...,
) -> int: ...
def changeDynamics(
    bodyUniqueId: int,
    linkIndex: int,
    *,
    localInertiaDiagonal: Sequence[float] = ...,
    linearDamping: float = ...,
    angularDamping: float = ...,
    jointDamping: float = ...,
    physicsClientId: int = ...,
) -> None: ...
def setJointMotorControlArray(
    bodyUniqueId: int,
    jointIndices: Sequence[int],
    controlMode: int,
    *,
    forces: Sequence[float] = ...,
    physicsClientId: int = ...,
) -> None: ...
def resetBaseVelocity(
    objectUniqueId: int,
    linearVelocity: Sequence[float] = ...,
    angularVelocity: Sequence[float] = ...,
    physicsClientId: int = ...,
) -> None: ...
def setGravity(gravX: float, gravY: float, gravZ: float, physicsClientId: int = ...) -> None: ...
def setTimeStep(timeStep: float, physicsClientId: int = ...) -> None: ...
def getBasePositionAndOrientation(
    bodyUniqueId: int, physicsClientId: int = ...
) -> tuple[_Vector, _Vector]: ...
def getBaseVelocity(bodyUniqueId: int, physicsClientId: int = ...) -> tuple[_Vector, _Vector]: ...
def getLinkStates(
    bodyUniqueId: int,
    linkIndices: Sequence[int],
    computeLinkVelocity: int = ...,
    computeForwardKinematics: int = ...,
    physicsClientId: int = ...,
) -> tuple[tuple[_Vector, ...], ...]: ...
def getJointStates(
    bodyUniqueId: int, jointIndices: Sequence[int], physicsClientId: int = ...
) -> tuple[tuple[float, float, _Vector, float], ...]: ...
def applyExternalTorque(
    objectUniqueId: int,
    linkIndex: int,
    torqueObj: Sequence[float],
    flags: int,
    physicsClientId: int = ...,
) -> None: ...
def applyExternalForce(
    objectUniqueId: int,
    linkIndex: int,
    forceObj: Sequence[float],
    posObj: Sequence[float],
    flags: int,
    physicsClientId: int = ...,
) -> None: ...
def stepSimulation(physicsClientId: int = ...) -> None: ...
