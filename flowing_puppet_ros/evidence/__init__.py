# SPDX-License-Identifier: Apache-2.0
"""How well a puppet explains data."""
