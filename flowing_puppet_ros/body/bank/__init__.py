# SPDX-License-Identifier: Apache-2.0
"""Bodies drawn from the model, for a cloud to choose from: who stands or walks, children, who sits, bends or crouches.

bank = make_upright_bank(StitchedPuppet.load()); bank.find_best(cloud, floor, 8)
"""
