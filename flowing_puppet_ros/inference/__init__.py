# SPDX-License-Identifier: Apache-2.0
"""How the best puppet is found: particle max-product over trees, diverse selection, particle swarms.

Costs of particles and of pairs of particles come in; the best particles go out. Nothing here knows about bodies. Read
`max_product` first.
"""
