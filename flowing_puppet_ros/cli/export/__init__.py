# SPDX-License-Identifier: Apache-2.0
"""Fitted bodies for other programs, for `flowing-puppet export`.

Fits and recordings come in; files of one format go out. Read `verb`.
"""
