# SPDX-License-Identifier: Apache-2.0
"""Bodies in clouds, meshes and calibrated cameras: hulls, fits, correspondence."""
