# SPDX-License-Identifier: Apache-2.0
"""Image likelihood of a puppet's parts: contours by steered HOG, colours, hands (Eqs. 20-22).

An image comes in, then contours; calibrated log-likelihoods go out. Read `likelihood` first.
"""
