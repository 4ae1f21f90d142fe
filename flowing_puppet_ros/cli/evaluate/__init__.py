# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate KIND`: one module per kind of measurement.

Arguments come in; a table, JSON, CSV and plots go out. Read `verb` first.
"""
