# SPDX-License-Identifier: Apache-2.0
"""Who is whom in several calibrated cameras: people in images become people in space, with ids that last.

The tracked people of each camera come in, instant by instant; people in 3D go out, each with its views. Read
`people_tracker` first.
"""
