# SPDX-License-Identifier: Apache-2.0
"""What verbs do with their arguments, apart from the parsers, so that a parser loads none of it.

Parsed arguments come in; files, tables and an exit status go out. Read `fit` first: its neighbours are built alike.
"""
