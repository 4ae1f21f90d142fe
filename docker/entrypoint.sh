#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
# Run a command where the workspace is sourced.
set -e
source /ros2_ws/install/setup.bash
exec "$@"
