# SPDX-License-Identifier: Apache-2.0
"""The Stitched Puppet learned from bodies: template, part spaces of shape and pose, pairwise Gaussians, joints.

Bodies of `learn.anny` come in; the weights of a 3D puppet go out. Read `training` first; `command` is the verb.
"""
