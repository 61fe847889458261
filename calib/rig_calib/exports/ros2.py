"""ROS 2: static transforms as a launch file, and the same tree as URDF for robot_state_publisher.

rig -> NAME_color_optical_frame -> NAME_depth_optical_frame. Optical frames have z forward, x right and y down
in the image (REP 103), which are OpenCV's axes: poses go out unchanged. `rig` has z up.
"""

import ast
from dataclasses import dataclass
from xml.etree import ElementTree

from rig_calib.exports.exported_rig import Export, ExportedCamera, ExportedRig
from rig_calib.exports.rotations import (
    pose_of_quaternion,
    pose_of_roll_pitch_yaw,
    quaternion_wxyz,
    roll_pitch_yaw,
)
from rig_protocol.errors import DataError
from rig_protocol.poses import Pose

LAUNCH_FILE = "rig.launch.py"
URDF_FILE = "rig.urdf"
ROOT = "rig"

COLOR_FRAME, DEPTH_FRAME = "_color_optical_frame", "_depth_optical_frame"
_TABLE = "TRANSFORMS"
_LAUNCH = f'''"""Static transforms of a calibrated rig, made by `rig-calib export`.

{ROOT} (z up) -> NAME{COLOR_FRAME} -> NAME{DEPTH_FRAME}: z forward, x right, y down in the image (REP 103).
"""

from launch import LaunchDescription
from launch_ros.actions import Node

# parent, child, (x, y, z) in metres, quaternion (x, y, z, w): pose of the child in the parent
{_TABLE} = [
{{rows}}
]


def generate_launch_description():
    nodes = []
    for number, (parent, child, translation, quaternion) in enumerate({_TABLE}):
        arguments = ["--frame-id", parent, "--child-frame-id", child]
        for flag, value in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), translation + quaternion):
            arguments += [f"--{{{{flag}}}}", repr(value)]
        nodes.append(
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name=f"rig_transform_{{{{number}}}}",
                arguments=arguments,
            )
        )
    return LaunchDescription(nodes)
'''


@dataclass(frozen=True, slots=True, eq=False)
class _Joint:
    """Pose of the child frame in its parent."""

    parent: str
    child: str
    T_parent_child: Pose


def export_launch(rig: ExportedRig) -> Export:
    """A Python launch file that publishes every transform with tf2_ros static_transform_publisher."""
    rows = []
    for joint in _joints(rig):
        w, x, y, z = quaternion_wxyz(joint.T_parent_child)
        translation = tuple(joint.T_parent_child[:3, 3].tolist())
        rows.append(f"    ({joint.parent!r}, {joint.child!r}, {translation!r}, {(x, y, z, w)!r}),")
    return Export({LAUNCH_FILE: _LAUNCH.format(rows="\n".join(rows))})


def read_launch(text: str) -> ExportedRig:
    """Cameras of a launch file that `export_launch` wrote; it is parsed, not run."""
    try:
        assigned = [node for node in ast.parse(text).body if isinstance(node, ast.Assign)]
        (table,) = (a.value for a in assigned if ast.unparse(a.targets[0]) == _TABLE)
        joints = [
            _Joint(str(parent), str(child), pose_of_quaternion((q[3], *q[:3]), translation))
            for parent, child, translation, q in ast.literal_eval(table)
        ]
    except (SyntaxError, IndexError, TypeError, ValueError) as error:
        raise DataError(f"not a launch file of rig-calib export: {error!r}") from error
    return _rig(joints)


def export_urdf(rig: ExportedRig) -> Export:
    """Links and fixed joints of the same tree."""
    robot = ElementTree.Element("robot", name="kinect_rig")
    ElementTree.SubElement(robot, "link", name=ROOT)
    for joint in _joints(rig):
        ElementTree.SubElement(robot, "link", name=joint.child)
        element = ElementTree.SubElement(robot, "joint", name=f"{joint.child}_joint", type="fixed")
        ElementTree.SubElement(element, "parent", link=joint.parent)
        ElementTree.SubElement(element, "child", link=joint.child)
        xyz = " ".join(map(repr, joint.T_parent_child[:3, 3].tolist()))
        rpy = " ".join(map(repr, roll_pitch_yaw(joint.T_parent_child[:3, :3])))
        ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)
    ElementTree.indent(robot)
    return Export({URDF_FILE: '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, "unicode") + "\n"})


def read_urdf(text: str) -> ExportedRig:
    """Cameras of a URDF that `export_urdf` wrote; DataError when it is none."""
    try:
        # expat, which reads it, bounds the expansion of entities by itself.
        robot = ElementTree.fromstring(text)  # noqa: S314
        joints = [
            _Joint(
                _attribute(joint, "parent", "link"),
                _attribute(joint, "child", "link"),
                pose_of_roll_pitch_yaw(
                    [float(angle) for angle in _attribute(joint, "origin", "rpy").split()],
                    [float(metres) for metres in _attribute(joint, "origin", "xyz").split()],
                ),
            )
            for joint in robot.iter("joint")
        ]
    except (ElementTree.ParseError, ValueError) as error:
        raise DataError(f"not a URDF of rig-calib export: {error}") from error
    return _rig(joints)


def _joints(rig: ExportedRig) -> list[_Joint]:
    joints = []
    for name, camera in zip(rig.ros_names(), rig.cameras, strict=True):
        joints.append(_Joint(ROOT, name + COLOR_FRAME, camera.T_rig_camera))
        if camera.T_color_depth is not None:
            joints.append(_Joint(name + COLOR_FRAME, name + DEPTH_FRAME, camera.T_color_depth))
    return joints


def _rig(joints: list[_Joint]) -> ExportedRig:
    depths = {joint.parent: joint.T_parent_child for joint in joints if joint.parent != ROOT}
    cameras = [
        ExportedCamera(
            joint.child.removesuffix(COLOR_FRAME), joint.T_parent_child, T_color_depth=depths.get(joint.child)
        )
        for joint in joints
        if joint.parent == ROOT
    ]
    return ExportedRig(tuple(cameras))


def _attribute(element: ElementTree.Element, child: str, name: str) -> str:
    found = element.find(child)
    value = None if found is None else found.get(name)
    if value is None:
        raise ValueError(f"a joint lacks {child} {name}")
    return value
