# SPDX-License-Identifier: Apache-2.0
"""A person's cloud, prepared: normals, closest points both ways, what a sensor at one place can see.

Points (N,3) in metres come in; normals, indexed clouds and correspondences to the vertices of a body go out. Read
`correspondence` first.
"""
