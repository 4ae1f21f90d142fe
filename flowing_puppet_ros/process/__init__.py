# SPDX-License-Identifier: Apache-2.0
"""How a process runs: its threads, its memory, and where its compiled kernels are kept.

Everything may import these modules; what they change, they change for the whole process. Read `threads` first.
"""
