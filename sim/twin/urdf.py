"""The robot as URDF, for viewers and simulators that know no robot TOML.

URDF puts the frame of a link that hangs on a joint *at that joint*; the head's frame is at its
centre. So rear links have their centre at x = -length/2 of their URDF frame. A link looks like its
mesh, where it has one (the file lies beside the URDF among the session's attachments), else like a
capsule: a cylinder from joint to joint with a ball at either end (URDF viewers know cylinders and
spheres, few know capsules).
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.kinematics import rotation_from_quaternion
from undulog.capture.robot.model import Joint, Link, Plane, Robot

_AXES = {Plane.HORIZONTAL: "0 0 1", Plane.VERTICAL: "0 1 0"}
_ALONG_X = "0 1.5707963267948966 0"  # a URDF cylinder lies along z


def urdf(robot: Robot) -> str:
    """Write the robot as URDF.

    Args:
        robot: The robot.

    Returns:
        XML text. Masses and inertias are exact, joints have limits, stall torque as effort, no
        damping and no friction (the servos bring their own).
    """
    root = ET.Element("robot", name=robot.name)
    material = ET.SubElement(root, "material", name="body")
    ET.SubElement(material, "color", rgba="0.55 0.6 0.65 1")
    for i, link in enumerate(robot.links):
        _add_link(root, link, 0.0 if i == 0 else -link.length / 2)
    for i, joint in enumerate(robot.joints):
        front, rear = robot.links[i], robot.links[i + 1]
        at = -front.length / 2 if i == 0 else -front.length
        _add_joint(root, joint, front.name, rear.name, at)
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def frame_origins(robot: Robot, centres: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Where the URDF frames of the links are, given the links' centres.

    Args:
        robot: The robot, n links.
        centres: In the world [m], shape (n, 3).
        quaternions: x, y, z, w, shape (n, 4).

    Returns:
        Origins of the URDF frames [m], shape (n, 3): the joint in front of each link, and the
        head's centre.
    """
    half = np.array([0.0, *(link.length / 2 for link in robot.links[1:])])
    return centres + half[:, None] * rotation_from_quaternion(quaternions)[:, :, 0]


def _add_link(root: ET.Element, link: Link, centre: float) -> None:
    element = ET.SubElement(root, "link", name=link.name)
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "origin", xyz=f"{centre!r} 0 0", rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(link.mass))
    ixx, iyy, izz = (repr(moment) for moment in link.inertia)
    ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    if link.mesh:
        visual = ET.SubElement(element, "visual")
        ET.SubElement(visual, "origin", xyz=f"{centre!r} 0 0", rpy="0 0 0")
        scale = " ".join([repr(link.mesh_scale)] * 3)
        shape = {"filename": link.mesh, "scale": scale}
        ET.SubElement(ET.SubElement(visual, "geometry"), "mesh", shape)
        return
    half, radius = link.length / 2, repr(link.radius)
    tube = {"radius": radius, "length": repr(link.length)}
    for shape, at, size in (
        ("cylinder", centre, tube),
        ("sphere", centre + half, {"radius": radius}),
        ("sphere", centre - half, {"radius": radius}),
    ):
        visual = ET.SubElement(element, "visual")
        ET.SubElement(visual, "origin", xyz=f"{at!r} 0 0", rpy=_ALONG_X)
        ET.SubElement(ET.SubElement(visual, "geometry"), shape, size)
        ET.SubElement(visual, "material", name="body")


def _add_joint(root: ET.Element, joint: Joint, parent: str, child: str, at: float) -> None:
    element = ET.SubElement(root, "joint", name=joint.name, type="revolute")
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "origin", xyz=f"{at!r} 0 0", rpy="0 0 0")
    ET.SubElement(element, "axis", xyz=_AXES[joint.plane])
    ET.SubElement(
        element,
        "limit",
        lower=repr(joint.lower),
        upper=repr(joint.upper),
        effort=repr(joint.servo.stall_torque),
        velocity=repr(joint.max_velocity),
    )
    ET.SubElement(element, "dynamics", damping="0", friction="0")
