# SPDX-License-Identifier: Apache-2.0
"""Measurements of a person in metres: stature, girths, lengths, volume, in a standard pose.

A fit of any pose comes in; the body in the template's pose and numbers by name go out. Read `measure` first.
"""
