# SPDX-License-Identifier: Apache-2.0
"""Recordings of several calibrated cameras: folders of videos into bags, and bags back to rigs and people.

Videos, keypoint files and a calibration come in, a bag goes out; read `import_folder` first.
"""
