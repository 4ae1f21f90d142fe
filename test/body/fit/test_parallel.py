# SPDX-License-Identifier: Apache-2.0
"""Work on threads: in order, alike on any number of them, and never on more than the process may use."""

import threading

import numba
import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]
from threadpoolctl import threadpool_limits

from flowing_puppet_ros.body.fit import hypotheses
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.process.threads import parallel_map, usable_threads


def test_results_keep_the_order_of_the_items() -> None:
    names = set()

    def work(item: int) -> int:
        names.add(threading.current_thread().name)
        return item * item

    assert parallel_map(work, range(50), 1) == parallel_map(work, range(50), 3) == [item * item for item in range(50)]
    assert threading.main_thread().name in names and len(names) > 1


def test_a_worker_that_may_use_one_core_uses_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
    assert usable_threads(8) == 1
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 4)
    assert [usable_threads(1), usable_threads(3), usable_threads(8)] == [1, 3, 4]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    points, normals = cloud_of(joints_of(), 2500)
    # So few particles misplace limbs, which are then searched again.
    small = FitterSettings(
        particles=8,
        iterations=8,
        local_particles=6,
        local_iterations=3,
        gauss_newton_steps=4,
        restarts=0,
        max_limb_repairs=1,
    )
    fits = []
    for threads in (1, 2):
        monkeypatch.setattr(hypotheses, "usable_threads", lambda _, count=threads: count)
        with threadpool_limits(limits=threads):
            fits.append(BodyFitter(StitchedPuppet.load("neutral"), small).fit(points, normals, seed=5))
    for name in ("vertices", "joints", "part_confidence"):
        assert np.array_equal(getattr(fits[0], name), getattr(fits[1], name))
    for name in ("energy", "confidence", "reliable", "two_way_distance"):
        assert getattr(fits[0], name) == getattr(fits[1], name)


@pytest.mark.slow
def test_another_seed_gives_another_fit() -> None:
    points, normals = cloud_of(joints_of(), 2500)
    small = FitterSettings(particles=4, iterations=2, local_iterations=0, restarts=0, max_limb_repairs=0)
    fitter = BodyFitter(StitchedPuppet.load("neutral"), small)
    one, other = (fitter.fit(points, normals, seed=seed).vertices for seed in (5, 6))
    assert not np.array_equal(one, other)
