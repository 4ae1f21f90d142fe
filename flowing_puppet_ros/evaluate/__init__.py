# SPDX-License-Identifier: Apache-2.0
"""Errors against a reference, of images, videos, bodies and bags, and the tables that show them.

Results and truths come in; figures as text, CSV and JSON go out. Read `joints` first.
"""
