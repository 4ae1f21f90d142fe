# SPDX-License-Identifier: Apache-2.0
"""How well surface points explain a cloud, by closest points (Eqs. 52-54) and by free space.

A cloud (N, 3) in metres comes in, then surface points; distances and costs go out. Read `data_term` first.
"""
