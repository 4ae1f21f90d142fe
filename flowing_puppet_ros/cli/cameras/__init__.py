# SPDX-License-Identifier: Apache-2.0
"""What the verbs `import` and `calibrate` do with recordings of several cameras.

Folders, calibration files and bags come in; bags and calibration files go out. Read `import_folder` first.
"""
