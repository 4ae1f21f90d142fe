# SPDX-License-Identifier: Apache-2.0
"""Errors of poses, tracks, bodies and bags against a reference, and their tables.

Results and ground truth come in; figures as text, CSV and JSON go out. Read `joints` first.
"""
