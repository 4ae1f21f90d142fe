# SPDX-License-Identifier: Apache-2.0
"""The loop of the thesis's video chapter, implemented literally (Eqs. 33-37) as a reference.

A clip, its flow and a first pose come in; the puppets of every frame go out. Read `loop` first, then `energy`.
"""
