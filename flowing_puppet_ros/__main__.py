# SPDX-License-Identifier: Apache-2.0
"""`python -m flowing_puppet_ros` is `flowing-puppet`."""

import sys

from flowing_puppet_ros.cli import main

if __name__ == "__main__":
    sys.exit(main())
