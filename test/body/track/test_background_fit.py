# SPDX-License-Identifier: Apache-2.0
"""Which clouds a body is led through from the one that was fitted to the newest."""

from typing import Any, cast

import numpy as np

from flowing_puppet_ros.body.track.background_fit import CATCH_UP_SPACING_NS, FEW, MAX_KEPT, BackgroundFit, Task
from flowing_puppet_ros.body.track.body_tracker import BodyTracker

TENTH = 100_000_000


class _Notes:
    """A tracker that notes the stamps of its clouds; the fit takes as long as `meanwhile` goes on."""

    def __init__(self, meanwhile: Any) -> None:
        self.stamps: list[int] = []
        self.meanwhile = meanwhile

    def track_or_refit(self, points: Any, normals: Any, stamp: int, *_: Any) -> None:
        self.stamps.append(stamp)
        self.meanwhile()

    def track(self, points: Any, normals: Any, stamp: int, viewpoint: Any) -> None:
        self.stamps.append(stamp)


def _task(stamp: int) -> Task:
    return Task(np.zeros((1, 3)), None, stamp, None, 0)


class _Later:
    """An executor that runs its task when it is told to."""

    def submit(self, task: Any) -> None:
        self.task = task


def _led(clouds: int) -> list[int]:
    pursuit, later = BackgroundFit(), _Later()

    def meanwhile() -> None:
        for number in range(1, clouds + 1):
            assert pursuit.add(1, _task(number * TENTH)) and not pursuit.add(2, _task(0))

    notes = _Notes(meanwhile)
    pursuit.start(1, cast(BodyTracker, notes), _task(0), cast(Any, later))
    later.task()
    finished = pursuit.finished()
    assert finished is not None and finished[1] is cast(Any, notes) and not pursuit.busy
    return notes.stamps


def test_a_body_is_led_evenly_through_what_was_kept_to_the_newest() -> None:
    assert _led(0) == [0]
    assert _led(1) == [0, TENTH]
    for clouds in (5, 20, 100, 1000):
        stamps = _led(clouds)
        assert stamps[-1] == clouds * TENTH and len(stamps) <= 1 + MAX_KEPT + FEW
        gaps = np.diff(stamps[:-1])
        assert len(gaps) == 0 or gaps.min() >= CATCH_UP_SPACING_NS
        assert len(gaps) < 2 or gaps.max() <= 2.5 * gaps.min(), stamps
