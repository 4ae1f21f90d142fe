# SPDX-License-Identifier: Apache-2.0
"""Work on several threads, and contexts of one BLAS or OpenCV thread that leave the user's counts as they were."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from flowing_puppet_ros.evidence.image.features import ImageFeatures
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.multiview.silhouette import _Colours, _grab_cut
from flowing_puppet_ros.process import threads
from flowing_puppet_ros.process.threads import one_blas_thread, one_opencv_thread, parallel_map

COUNT = 3
IMAGE = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)


@pytest.fixture(autouse=True)
def counts_of_the_user() -> Iterator[None]:
    # An earlier test may have left work in the background that holds a limit for a moment longer.
    while threads._BLAS._callers or threads._OPENCV._callers:
        time.sleep(0.05)
    former = cv2.getNumThreads()
    cv2.setNumThreads(COUNT)
    with threadpool_limits(COUNT):
        yield
    cv2.setNumThreads(former)


def blas_threads() -> int:
    return max(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")


LIBRARIES = pytest.mark.parametrize(
    ("one_thread", "count"), [(one_blas_thread, blas_threads), (one_opencv_thread, cv2.getNumThreads)]
)
type Context = Callable[[], AbstractContextManager[None]]


@LIBRARIES
def test_contexts_nest_and_give_the_count_back(one_thread: Context, count: Callable[[], int]) -> None:
    before = count()
    assert before > 1
    with one_thread():
        with one_thread():
            assert count() == 1
        assert count() == 1
    assert count() == before
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    assert count() == before


@LIBRARIES
def test_the_last_of_several_threads_gives_the_count_back(one_thread: Context, count: Callable[[], int]) -> None:
    before = count()
    entered, left = threading.Event(), threading.Event()

    def first() -> None:
        with one_thread():
            entered.wait(10)
        left.set()

    thread = threading.Thread(target=first)
    thread.start()
    with one_thread():
        entered.set()
        assert left.wait(10)
        assert count() == 1, "the thread that has left must not raise the count of the one that is inside"
    thread.join()
    assert count() == before


@LIBRARIES
def test_many_threads_at_once_see_one_thread(one_thread: Context, count: Callable[[], int]) -> None:
    before = count()

    def work(_: int) -> int:
        with one_thread():
            return count()

    assert set(parallel_map(work, range(200), 8)) == {1}
    assert count() == before


def test_a_count_that_the_user_sets_meanwhile_is_kept() -> None:
    with one_opencv_thread():
        cv2.setNumThreads(2)
        with one_opencv_thread():
            assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == 2


def test_one_thread_of_the_user_stays_one() -> None:
    cv2.setNumThreads(1)
    with one_opencv_thread():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == 1


@pytest.mark.parametrize(
    "call",
    [
        lambda: OpticalFlow()(IMAGE, IMAGE),
        lambda: ImageFeatures.of(IMAGE).level(0),
        lambda: PartDetector.load().detect(IMAGE),
        lambda: _grab_cut(
            IMAGE, np.where(IMAGE[..., 0] > 99, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8), 1, _Colours()
        ),
    ],
    ids=["flow", "evidence", "detector", "silhouette"],
)
def test_what_works_on_one_thread_leaves_the_user_s_counts_alone(call: Callable[[], object]) -> None:
    before = cv2.getNumThreads(), blas_threads()
    call()
    assert (cv2.getNumThreads(), blas_threads()) == before == (COUNT, before[1])
