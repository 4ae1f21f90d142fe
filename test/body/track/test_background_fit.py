# SPDX-License-Identifier: Apache-2.0
"""Which clouds a body is led through from the one that was fitted to the newest."""

from typing import Any, cast

import numpy as np
from kept_tasks import KeptTasks  # type: ignore[import-not-found]

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.track.background_fit import (
    CATCH_UP_SPACING_NS,
    MAX_KEPT,
    NEARLY_DONE,
    BackgroundFit,
    SeededCloud,
)
from flowing_puppet_ros.body.track.body_tracker import BodyTracker

TENTH = 100_000_000


class _Notes:
    """A tracker that notes the stamps of its clouds; the fit takes as long as `meanwhile` goes on."""

    def __init__(self, meanwhile: Any) -> None:
        self.stamps: list[int] = []
        self.meanwhile = meanwhile

    def track_or_refit(self, person: PersonCloud, *_: Any) -> None:
        self.stamps.append(person.stamp)
        self.meanwhile()

    def track(self, person: PersonCloud) -> None:
        self.stamps.append(person.stamp)


def _cloud(stamp: int) -> SeededCloud:
    return SeededCloud(PersonCloud(np.zeros((1, 3)), None, stamp), 0)


def _led(clouds: int) -> list[int]:
    background, later = BackgroundFit(), KeptTasks()

    def meanwhile() -> None:
        for number in range(1, clouds + 1):
            assert background.add(1, _cloud(number * TENTH)) and not background.add(2, _cloud(0))

    notes = _Notes(meanwhile)
    background.start(1, cast(BodyTracker, notes), _cloud(0), cast(Any, later))
    later.run()
    finished = background.take_finished()
    assert finished is not None and finished[1] is cast(Any, notes) and not background.busy
    return notes.stamps


def test_a_body_is_led_evenly_through_what_was_kept_to_the_newest() -> None:
    assert _led(0) == [0]
    assert _led(1) == [0, TENTH]
    for clouds in (5, 20, 100, 1000):
        stamps = _led(clouds)
        assert stamps[-1] == clouds * TENTH and len(stamps) <= 1 + MAX_KEPT + NEARLY_DONE
        gaps = np.diff(stamps[:-1])
        assert len(gaps) == 0 or gaps.min() >= CATCH_UP_SPACING_NS
        assert len(gaps) < 2 or gaps.max() <= 2.5 * gaps.min(), stamps
