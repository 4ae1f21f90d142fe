# SPDX-License-Identifier: Apache-2.0
"""MCAP and rosbag2 bags in and out, and the replay of the stream components over them."""
