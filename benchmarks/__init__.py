# SPDX-License-Identifier: Apache-2.0
"""Speed and accuracy beside plain reference versions and what people use today: `flowing-puppet bench`.

Not installed with the package. Drawn images and synthetic clouds come in; ratios taken in one run go out. Read `speed`
first; `plain_search` is the 3D search without compiled code, `peers` has the programs of others.
"""
