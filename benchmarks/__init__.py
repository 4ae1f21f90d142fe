# SPDX-License-Identifier: Apache-2.0
"""Speed and accuracy against plain reference versions and common alternatives: `flowing-puppet bench`.

Not installed with the package. Drawn images and synthetic clouds come in; ratios measured in one run go out. Read
`speed` first; `plain_search` is the 3D search without compiled code, `peers` runs the programs of others.
"""
