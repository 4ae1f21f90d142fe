# SPDX-License-Identifier: Apache-2.0
"""ROS messages in, ROS messages out, without ROS: what the live nodes and the bag replay both run."""
