# SPDX-License-Identifier: Apache-2.0
"""Load the message libraries of this virtual environment, which a sourced ROS only looks up by name.

The set-up installs this start-up hook beside the messages when it builds them against a sourced ROS. ROS opens type
support as `lib<package>__<kind>.so` without a path, and finds a library of that name that is already loaded.
"""

import contextlib
import ctypes
import sys
from pathlib import Path

for library in sorted(Path(sys.prefix, "lib").glob("lib*__rosidl_*.so")):
    # Without a sourced ROS the dependencies of these libraries are missing, and then they are not needed either.
    with contextlib.suppress(OSError):
        ctypes.CDLL(str(library))
