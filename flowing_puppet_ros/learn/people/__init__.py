# SPDX-License-Identifier: Apache-2.0
"""Learn what tells people from what is none in scans of scenes: a cheap filter by shape, and how far a fit proves one.

Scans with labels come in, as `flowing-puppet evaluate scenes --write` makes them; weights and their card go out. Read
`command` first.
"""
