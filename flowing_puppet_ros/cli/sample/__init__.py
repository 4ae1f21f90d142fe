# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample MODEL`: random puppets of a learned model.

Arguments come in; pictures and meshes go out. Read `verb` first.
"""
