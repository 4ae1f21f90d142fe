# SPDX-License-Identifier: Apache-2.0
"""ROS messages to and from arrays, one file per family of messages; nothing here keeps state.

Messages of rclpy or of a bag come in and arrays go out, or the other way round through a `MessageFactory`. Read
`message_types` first.
"""
