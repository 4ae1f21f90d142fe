# SPDX-License-Identifier: Apache-2.0
"""Readers of the files of meshes and clouds, each by itself; damaged and hostile ones end in an `InputError`.

A path comes in; points, faces and what else the file says about them go out, in its own frame and unit. The room
`body.scans` chooses among them by the file's name. Read `tables` first.
"""
