# SPDX-License-Identifier: Apache-2.0
"""Load the message libraries of this virtual environment, which a sourced ROS looks for by bare name only.

The set-up installs this start-up hook beside the messages when it builds them against a sourced ROS. ROS opens type
support as `lib<package>__<kind>.so` without a path; one that is already loaded is found under that name.
"""

import contextlib
import ctypes
import sys
from pathlib import Path

for library in sorted(Path(sys.prefix, "lib").glob("lib*__rosidl_*.so")):
    # Without ROS sourced in this shell the libraries that these need are missing; then nobody asks for these either.
    with contextlib.suppress(OSError):
        ctypes.CDLL(str(library))
