# SPDX-License-Identifier: Apache-2.0
"""What `flowing-puppet fit` does with one file: who is in it, in what frames and units, fit them, write the results.

A path and the options of the verb come in; files and a summary for JSON go out. Read `fit_file` first.
"""
