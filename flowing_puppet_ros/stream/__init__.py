# SPDX-License-Identifier: Apache-2.0
"""ROS messages in, ROS messages out, without ROS: what the live nodes and the bag replay both run.

`component` says what a component is; `components` has one for each node, `messages` the conversions, and `pairing` the
waiting for inputs of one moment. Read `component` first.
"""
