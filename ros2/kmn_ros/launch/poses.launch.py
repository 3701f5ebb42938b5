"""Start the node: ros2 launch kmn_ros poses.launch.py part:=part.stl depth:=/camera/depth/image_rect_raw."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

TOPICS = {
    "depth": "/camera/depth/image_rect_raw",
    "camera_info": "/camera/depth/camera_info",
    "points": "/camera/depth/points",
}
PARAMETERS = {"part": None, "input": "depth", "min_probability": "0.8", "on_demand": "false"}
TYPES = {"min_probability": float, "on_demand": bool}  # all others are text


def generate_launch_description() -> LaunchDescription:
    """Return what is started: the node, with its topics and its commonest parameters as arguments."""
    arguments = [DeclareLaunchArgument(name, default_value=value) for name, value in (TOPICS | PARAMETERS).items()]
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=TYPES.get(name, str)) for name in PARAMETERS
    }
    node = Node(
        package="kmn_ros",
        executable="poses",
        name="kmn_poses",
        parameters=[parameters],
        remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
        output="screen",
    )
    return LaunchDescription([*arguments, node])
