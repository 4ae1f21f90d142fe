# SPDX-License-Identifier: Apache-2.0
"""A scene as one sensor, or several, saw it, before anybody is found in it.

The clouds of sensors come in; one cloud with its range images, without what another sensor saw through, goes out.
"""
