# SPDX-License-Identifier: Apache-2.0
"""What every test runs under: an own ROS domain on this machine only, and one thread a library."""

import os

# Below 102 no domain's ports meet the ports that Linux gives to other programs.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
