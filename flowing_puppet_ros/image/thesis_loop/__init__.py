# SPDX-License-Identifier: Apache-2.0
"""The loop of the thesis's video chapter, to the letter (Eqs. 33-37): a reference.

A clip, its flow and a first pose come in; the puppets of every frame go out. Read `loop` first, then `energy`.
"""
