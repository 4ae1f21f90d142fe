# SPDX-License-Identifier: Apache-2.0
"""A person's cloud, prepared: normals, two-way correspondences, what a sensor at one viewpoint can see.

Points (N, 3) in metres come in; normals, indexed clouds and correspondences to the vertices of a body go out. Read
`correspondence` first.
"""
