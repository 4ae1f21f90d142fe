# SPDX-License-Identifier: Apache-2.0
"""What can be computed from an input, for `flowing-puppet doctor`.

Paths come in; findings are printed. Read `verb`.
"""
