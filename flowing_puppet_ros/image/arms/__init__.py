# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of elbows and wrists over time, scored by the image and by the flow between images.

Candidate positions of the arms in each image come in; the best sequence goes out, live (a forward pass) or over a whole
clip (Viterbi). Read `hypotheses` first.
"""
