# SPDX-License-Identifier: Apache-2.0
"""Messages of other systems to those of ROS 2 Jazzy: ROS 1, Foxglove's schemas, and other versions of a definition.

A stored topic comes in; the ROS 2 type of its messages and a function from their bytes to CDR go out. Read `convert`
first, then `foxglove`, which has the meaning of the schemas.
"""
