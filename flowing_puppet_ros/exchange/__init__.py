# SPDX-License-Identifier: Apache-2.0
"""Bodies for other programs: fits and recordings read as motions of people, and written as GLB, BVH, TRC, OBJ and JSON.

A fit or a recording of bodies comes in; files in the conventions of their formats go out. Read `motion` first, then
`bones`, the skeleton that the formats share.
"""
