# SPDX-License-Identifier: Apache-2.0
"""The search for a body by diverse particle max-product on the 16 parts (D-PMP, Eqs. 44-64).

The cloud of one person and first guesses come in; diverse bodies with their energies go out, improved by
Levenberg-Marquardt (Eqs. 55-64). Read `dpmp` first, then `energy` and `levenberg`.
"""
