# Not run: needs ROS 2. tests/test_recipes.py runs the conversions in ros_poses.py.
"""`ros2 launch ./splatfix.launch.py scene:=studio camera:=/camera`: starts splatfix_node.py beside this file."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

GIVEN = {"url": "http://127.0.0.1:8000", "scene": "studio", "metres_per_unit": "1.0", "camera": "/camera"}


def generate_launch_description():
    """Return the node with its parameters and the camera's topics."""
    camera = LaunchConfiguration("camera")
    command = ["python3", str(Path(__file__).with_name("splatfix_node.py")), "--ros-args"]
    for name in ("url", "scene", "metres_per_unit"):
        command += ["-p", [f"{name}:=", LaunchConfiguration(name)]]
    for topic in ("camera_info", "image/compressed"):
        command += ["-r", [f"{topic}:=", camera, f"/{topic}"]]
    arguments = [DeclareLaunchArgument(name, default_value=value) for name, value in GIVEN.items()]
    return LaunchDescription([*arguments, ExecuteProcess(cmd=command, output="screen")])
