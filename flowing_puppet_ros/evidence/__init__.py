# SPDX-License-Identifier: Apache-2.0
"""How well a puppet explains data: an image (`image`) or a cloud (`cloud`).

The data comes in once, then poses to score; costs go out. Read `image.likelihood` or `cloud.data_term` first.
"""
