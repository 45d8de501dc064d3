"""The cell under ROS 2: ros2 launch jigsaw_nodes jigsaw.launch.py [namespace:=cell] [source:=FOLDER] ...

A node that ends by a fault (a participant that has gone deaf among them) is started again.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

HERE = Path(__file__).resolve().parent

ARGUMENTS = {
    "namespace": ("", "namespace of the three nodes"),
    "image": ("image", "topic of the camera; its compressed frames are expected on <image>/compressed"),
    "source": ("", "folder of pictures to take instead of the camera"),
    "metres_per_pixel": ("0.0001", "scale of the pictures on the table [m/px]"),
    "policy": ("standard", "rules of the assembly: standard or paper"),
    "journal": ("", "folder for the pieces that the solver node has taken in, so that they outlast it"),
    "use_sim_time": ("false", "take the time from /clock"),
}


def generate_launch_description():
    def node(name, parameters=None, remappings=None):
        common = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
        return Node(
            package="jigsaw_nodes",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[str(HERE / f"{name}.param.yaml"), {**common, **(parameters or {})}],
            remappings=remappings or [],
            respawn=True,
            respawn_delay=0.5,
            # A node that has reached its limit of memory must end, not ask for more to tell where it was. With one
            # arena glibc's allocator keeps less of what pieces leave behind.
            additional_env={"RUST_BACKTRACE": "0", "MALLOC_ARENA_MAX": "1"},
            output="screen",
        )

    image = LaunchConfiguration("image")
    return LaunchDescription(
        [
            DeclareLaunchArgument(name, default_value=default, description=description)
            for name, (default, description) in ARGUMENTS.items()
        ]
        + [
            node(
                "capture_node",
                {
                    "source": ParameterValue(LaunchConfiguration("source"), value_type=str),
                    "metres_per_pixel": ParameterValue(LaunchConfiguration("metres_per_pixel"), value_type=float),
                },
                [("image", image), ("image/compressed", [image, "/compressed"])],
            ),
            node("feature_node"),
            node(
                "solver_node",
                {
                    "policy": ParameterValue(LaunchConfiguration("policy"), value_type=str),
                    "journal": ParameterValue(LaunchConfiguration("journal"), value_type=str),
                },
            ),
        ]
    )
