# SPDX-License-Identifier: Apache-2.0
"""rclpy nodes: the only package that imports rclpy.

Messages on topics come in and go out; between them works a component of `stream`. Read `component_node` first, then
`session` with its `inputs`, `outputs` and `worker`; `main` has the programs.
"""
