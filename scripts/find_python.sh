#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Print the path of a Python 3.12 that really runs, or say in one sentence how to get one.
# PYTHON=/path/to/python chooses one by hand.

runs() {
    [ -x "$1" ] && "$1" -S -c 'import sys, ctypes, ssl; sys.exit(sys.version_info[:2] != (3, 12))' >/dev/null 2>&1
}

candidates() {
    if [ -n "$PYTHON" ]; then
        command -v "$PYTHON"
        return
    fi
    # ROS 2 Jazzy is built for the system's Python: with ROS sourced that one comes first.
    [ "$ROS_DISTRO" = jazzy ] && echo /usr/bin/python3.12
    command -v python3.12
    command -v python3
    echo /usr/bin/python3.12
    echo /usr/local/bin/python3.12
    ls -d "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.12*/bin/python3.12 2>/dev/null
    uv python find --no-project --system 3.12 2>/dev/null
    ls -d "${XDG_DATA_HOME:-$HOME/.local/share}"/uv/python/cpython-3.12*/bin/python3.12 2>/dev/null
    uv python install --quiet 3.12 >/dev/null 2>&1 && uv python find --no-project --system 3.12 2>/dev/null
}

# The pipe lets the first hit end the search, so that uv is asked (and downloads) only when nothing else runs.
found=$(candidates | while read -r candidate; do
    if runs "$candidate"; then
        echo "$candidate"
        break
    fi
done)
if [ -z "$found" ]; then
    if [ -n "$PYTHON" ]; then
        echo "PYTHON is $PYTHON, which is not a Python 3.12 that runs: give the path of one, or unset PYTHON." >&2
    else
        echo "No Python 3.12 was found: install one (apt-get install python3.12 python3.12-dev python3.12-venv," \
            "pyenv install 3.12 or uv python install 3.12), or set PYTHON to its path." >&2
    fi
    exit 1
fi
echo "$found"
