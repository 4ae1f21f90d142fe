# SPDX-License-Identifier: Apache-2.0
"""Poses in single images against the ground truth: correct parts (PCP), ranks of limbs and hands.

Images with annotated people come in; figures go out. Read `pcp` first.
"""
