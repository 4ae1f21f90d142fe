# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: arguments, nodes, and which topics of the graph they could mean.

Names of arguments and what the graph publishes come in; launch actions go out. Read `actions` first; it needs the
packages launch and launch_ros, which come with a ROS and not with its wheels.
"""
