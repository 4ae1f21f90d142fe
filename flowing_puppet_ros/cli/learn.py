# SPDX-License-Identifier: Apache-2.0
"""Learn body models (`ds`, `sp`) from synthetic people; `likelihood`, `detector`, `hands` from annotated images."""

SUBVERBS = {
    "ds": "flowing_puppet_ros.learn.ds.command",
    "sp": "flowing_puppet_ros.learn.sp.command",
    "likelihood": "flowing_puppet_ros.learn.likelihood.command",
    "detector": "flowing_puppet_ros.learn.detector.command",
    "hands": "flowing_puppet_ros.learn.thesis_loop.hands_command",
    "people": "flowing_puppet_ros.learn.people.command",
    "flowing": "flowing_puppet_ros.learn.thesis_loop.energy_weights_command",
}
EXTRA = "learn"
