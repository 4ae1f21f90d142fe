# SPDX-License-Identifier: Apache-2.0
"""Memory that is given back: which mappings may be, and that a process still runs and is smaller afterwards."""

import subprocess
import sys

import pytest

from flowing_puppet_ros.process.memory import find_unchanged

ENTRY = """{start}-{end} {mode} 00000000 fe:00 247260 {path}
Size:               8192 kB
Rss:                {resident} kB
Anonymous:          {changed} kB
VmFlags: rd mr mw me
"""


def make_entry(
    mode: str = "r-xp", path: str = "/usr/lib/libllvmlite.so", resident: int = 4096, changed: int = 0
) -> str:
    return ENTRY.format(
        start="7f0000000000", end="7f0000800000", mode=mode, path=path, resident=resident, changed=changed
    )


def test_pages_of_a_library_are_found() -> None:
    assert list(find_unchanged(make_entry())) == [(0x7F0000000000, 0x800000)]


@pytest.mark.parametrize(
    "entry",
    [
        make_entry(mode="rw-p"),
        make_entry(mode="r--s"),
        make_entry(changed=4),
        make_entry(path="[heap]"),
        make_entry(path=""),
        make_entry(path="/data/people.bin"),
        make_entry(resident=12),
    ],
    ids=["writable", "shared", "relocated", "heap", "anonymous", "no library", "small"],
)
def test_what_others_may_have_changed_stays(entry: str) -> None:
    assert list(find_unchanged(entry)) == []
    assert list(find_unchanged(entry + make_entry())) == [(0x7F0000000000, 0x800000)]


@pytest.mark.slow
def test_a_process_is_smaller_and_its_compiled_code_still_runs() -> None:
    program = """
import numpy as np
from flowing_puppet_ros.process.memory import limit_arenas, return_start_memory
limit_arenas()
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
index = NearestPoints(np.random.default_rng(0).random((500, 3)))
before = index.query(index.points)
pages = lambda: int(open("/proc/self/statm").read().split()[1])
large = pages()
return_start_memory()
small = pages()
after = index.query(index.points + 1e-3)
assert (before[1] == np.arange(500)).all() and (after[1] == np.arange(500)).all()
print(small / large)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 0.8
