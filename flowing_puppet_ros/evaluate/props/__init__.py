# SPDX-License-Identifier: Apache-2.0
"""People on, behind or with things that touch them, as a colour and a depth camera see them.

A studio and a generator go in; frames come out, as those of `evaluate.rgbd`. Read `scenes` first, then `furniture`.
"""
