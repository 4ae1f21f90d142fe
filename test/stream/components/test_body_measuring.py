# SPDX-License-Identifier: Apache-2.0
"""Sizes of people as messages: what they say, of whom, how often, and what their definitions are."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.measurements.measure import DEFINITIONS
from flowing_puppet_ros.body.track.tracked_body import TrackedBody, TrackStatus
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.components import body_outputs
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.components.body_outputs import BodyOutputs, BodyOutputSettings
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriSettings
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
DEFINITION_FILE = Path(__file__).parents[3] / "msg_defs" / "msg" / "BodyMeasurements.msg"


def person(model: StitchedPuppet, identity: str, status: TrackStatus = TrackStatus.TRACKED) -> TrackedBody:
    """Return a body at rest."""
    state = model.rest_state()
    vertices = model.vertices(state)
    seen = BodyVisibility.of_vertices(model, np.full(len(vertices), Visibility.SEEN, np.int8))
    fit = BodyFit(state, vertices, model.joints(vertices), 1.0, np.ones(16), 0.75, True, 0.01, seen)
    return TrackedBody(identity, fit, status)


def outputs(model: StitchedPuppet, measure: bool = True) -> BodyOutputs:
    return BodyOutputs(BodyOutputSettings(measure=measure), Ros4HriSettings(), FACTORY, model)


def send(shown: BodyOutputs, seconds: float, *bodies: TrackedBody) -> Any:
    """Return the message for the bodies at a time, None if there is none."""
    header = make_header(FACTORY, int(seconds * 1e9), "lidar")
    return dict(shown.make(header, bodies)).get("measurements")


def test_a_body_at_rest_has_the_sizes_of_its_mesh(model: StitchedPuppet) -> None:
    message = send(outputs(model), 1.0, person(model, "abcde"))
    vertices = model.vertices(model.rest_state())
    (sizes,) = message.people
    assert (sizes.id, sizes.reliable, sizes.confidence) == ("abcde", True, 0.75)
    assert message.header.frame_id == "lidar"
    assert sizes.stature == pytest.approx(np.ptp(vertices[:, 2]), abs=1e-3)
    # Divergence theorem, by another sum than the code's.
    a, b, c = (vertices[model.faces[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a) / 2
    assert sizes.volume == pytest.approx(((a + b + c)[:, 2] / 3 * outward[:, 2]).sum(), rel=0.01)
    typestore().serialize_cdr(message, "flowing_puppet_msgs/msg/BodyMeasurementsArray")


def test_everybody_is_measured_once_a_second(model: StitchedPuppet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_outputs, "measure_fit", lambda *_: dict.fromkeys(DEFINITIONS, 1.0))
    shown, first, second = outputs(model), person(model, "first"), person(model, "other")
    assert [each.id for each in send(shown, 10.0, first).people] == ["first"]
    assert [each.id for each in send(shown, 10.5, first, second).people] == ["other"]
    assert send(shown, 10.9, first, second) is None
    assert [each.id for each in send(shown, 11.0, first, second).people] == ["first"]
    assert send(shown, 12.0, replace(first, status=TrackStatus.HIDDEN)) is None, "nothing new is seen of them"
    assert [each.id for each in send(shown, 3.0, first).people] == ["first"], "the stamps began anew"
    assert send(shown, 3.1) is None
    assert [each.id for each in send(shown, 3.2, first).people] == ["first"], "somebody new with an old id"


def test_without_the_parameter_there_is_no_topic(model: StitchedPuppet) -> None:
    assert send(outputs(model, measure=False), 1.0, person(model, "abcde")) is None
    for measure in (False, True):
        settings = BodyFitterSettings(output=BodyOutputSettings(measure=measure))
        names = [port.name for port in BodyFitterComponent(settings, FACTORY).outputs]
        assert ("measurements" in names) is measure


def test_the_message_has_the_definitions_that_the_measurements_have() -> None:
    fields = re.findall(r"^float32 (\w+) +# (m3?), (.+)$", DEFINITION_FILE.read_text(), flags=re.MULTILINE)
    assert fields == [(name, definition.unit, definition.text) for name, definition in DEFINITIONS.items()]
