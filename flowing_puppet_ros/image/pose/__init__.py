# SPDX-License-Identifier: Apache-2.0
"""The pose of one person in one image, by diverse particle max-product over the parts of a puppet.

An image and roughly where a person is come in; the best puppet and other hypotheses of the arms go out, with energies.
Read `estimator` first, then `particle_search`.
"""
