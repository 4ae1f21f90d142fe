# SPDX-License-Identifier: Apache-2.0
"""More input than a node can work on: the newest cloud with its puppets is taken, others are dropped and counted."""

from collections import deque
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.stream.component import Output
from flowing_puppet_ros.stream.components.body_fitter import MAX_WAITING, BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, PUPPETS
from flowing_puppet_ros.stream.pairing.stamp_buffer import CloudLine

FACTORY = BagMessageFactory()
PERIOD_NS = 33_000_000
END = 200  # periods


class Overload:
    """A body fitter at work on an empty room, to which a camera and a tracker send more than it can take.

    Each fit takes `periods` of the camera; puppets come `lag` periods after their images.
    """

    def __init__(self, periods: int, lag: int) -> None:
        self.component = BodyFitterComponent(BodyFitterSettings.from_mapping({}), FACTORY)
        for port in ("puppets", "puppets/camera_info"):
            self.component.set_expected(port, True)
        self.component.background = object()  # type: ignore[assignment]  # as in a node
        self.component.is_behind = lambda: bool(self.waiting)
        self.waiting: deque[tuple[str, Any]] = deque()
        self.now = 0
        self.published: list[tuple[int, int]] = []
        """Stamp and time of publication, periods."""
        self._periods, self._lag = periods, lag

    def send(self) -> None:
        """Let one period pass."""
        self.now += 1
        header = make_header(FACTORY, PERIOD_NS * self.now, "eye")
        k = np.array([60.0, 0, 15.5, 0, 60.0, 11.5, 0, 0, 1.0])
        info = FACTORY.make(CAMERA_INFO, header=header, k=k, d=np.zeros(5), width=32, height=24)
        wall = make_image(FACTORY, header, np.full((24, 32), 3.0, np.float32), "32FC1")
        self.waiting += [("camera_info", info), ("puppets/camera_info", info), ("depth", wall)]
        if self.now > self._lag:
            earlier = make_header(FACTORY, PERIOD_NS * (self.now - self._lag), "eye")
            self.waiting.append(("puppets", FACTORY.make(PUPPETS, header=earlier, puppets=[])))

    def work(self) -> None:
        """Take in what waits; the time of what is fitted passes."""
        while self.waiting and self.now < END:
            outputs = self.component.handle(*self.waiting.popleft())
            stamps = [stamp_ns(message) // PERIOD_NS for name, message in outputs if name == "bodies"]
            for _ in range(self._periods * len(stamps)):
                self.send()
            self.published += [(stamp, self.now) for stamp in stamps]


@pytest.mark.parametrize(("periods", "lag"), [(6, 0), (6, 3), (2, 25), (0, 50)])
def test_clouds_come_with_their_puppets_however_slow_the_work_and_late_the_puppets(periods: int, lag: int) -> None:
    overload = Overload(periods, lag)
    while overload.now < END:
        overload.send()
        overload.work()
    stamps, times = np.array(overload.published).T
    assert len(stamps) >= (END - lag) // (periods + lag + 2)
    assert (np.diff(stamps) > 0).all()
    delays = times - stamps
    # The puppets' lag, the fit that went before, the fit itself, and half of the gap that thinning leaves in the line.
    assert delays.max() <= lag + 2 * periods + 1 + lag / 2
    assert overload.component.counters["clouds without puppets"] == 0
    assert overload.component.report.drain_warnings() == []
    received = overload.component.counters["received depth"]
    left = received - len(stamps) - overload.component.dropped["depth"]
    assert 0 <= left <= MAX_WAITING  # all the others are counted


def test_who_keeps_up_drops_nothing() -> None:
    overload = Overload(0, 2)
    for _ in range(20):
        overload.send()
        while overload.waiting:
            port, message = overload.waiting.popleft()
            waiting, overload.waiting = overload.waiting, deque()
            outputs: Output = overload.component.handle(port, message)
            overload.published += [(stamp_ns(made), 0) for name, made in outputs if name == "bodies"]
            overload.waiting = waiting
    assert [stamp // PERIOD_NS for stamp, _ in overload.published] == list(range(1, 19))
    assert not overload.component.dropped


def test_puppets_that_stay_away_are_waited_for_only_for_a_while() -> None:
    overload = Overload(0, 1000)
    while overload.now < 63:
        overload.send()
        overload.work()
    # 2 s are 60 periods: then clouds are used alone, the newest one first.
    first, at = overload.published[0]
    assert 60 <= at <= 62
    assert at - first <= 1


def test_a_long_line_is_thinned_evenly_and_keeps_its_ends() -> None:
    dropped: list[int] = []
    line = CloudLine(dropped.append)
    for number in range(40):
        line.append(number, number, 5)
    kept = [stamp for stamp, _ in line.waiting]
    assert len(kept) == 5
    assert (kept[0], kept[-1]) == (0, 39)
    assert max(np.diff(kept)) <= 20
    assert sorted(dropped + kept) == list(range(40))
