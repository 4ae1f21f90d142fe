# SPDX-License-Identifier: Apache-2.0
"""rclpy nodes: the only package that imports rclpy."""
