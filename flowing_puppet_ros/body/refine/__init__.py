# SPDX-License-Identifier: Apache-2.0
"""The refinement of a body: Gauss-Newton over all parts together, then what the model cannot express.

A body near its cloud comes in; one on it goes out. Read `gauss_newton` first, then `normal_equations`.
"""
