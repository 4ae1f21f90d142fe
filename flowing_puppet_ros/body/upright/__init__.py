# SPDX-License-Identifier: Apache-2.0
"""People who stand or walk in a scan of a scene: a first body with its soles on the floor, and whether it is a person.

A scene's points (N, 3) m and the candidates of the segmentation come in; bodies that the scan's rays confirm go out.
Read `person_finder` first, then `upright_fit` and `verification`.
"""
