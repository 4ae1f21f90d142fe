# SPDX-License-Identifier: Apache-2.0
"""The kinds of `flowing-puppet evaluate` that are about people in clouds and depth images.

The verb's arguments come in; tables, files and an exit status go out. Read `bodies` first.
"""
