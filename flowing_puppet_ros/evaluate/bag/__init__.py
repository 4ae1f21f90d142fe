# SPDX-License-Identifier: Apache-2.0
"""The figures of a replay's bag: bodies against true people, ids, latency, drops.

The input and the output bag of a replay come in; figures go out. Read `recording` first, then `figures`.
"""
