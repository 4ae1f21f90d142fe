# SPDX-License-Identifier: Apache-2.0
"""Components: what waits for what, the same answer in any order of arrival, restarts, lazy outputs, bad input."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from golden_streams import (  # type: ignore[import-not-found]
    FACTORY,
    Stream,
    drive,
    hull_stream,
    interleaved,
    read_golden,
    tracker,
)

from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.components.optical_flow import OpticalFlowComponent
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent, VisualHullSettings
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_flow, decode_image, make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, PUPPETS
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints


@pytest.fixture(scope="module")
def recorded() -> dict[str, list[Any]]:
    return read_golden()


@pytest.fixture(scope="module")
def images(recorded: dict[str, list[Any]]) -> list[Any]:
    return recorded["/cam1/image/compressed"]


@pytest.fixture(scope="module")
def detections(recorded: dict[str, list[Any]]) -> dict[int, Any]:
    return {stamp_ns(message): message for message in recorded["/cam1/detections"]}


def puppets(found: Stream) -> list[bytes]:
    return [bytes(typestore().serialize_cdr(message, PUPPETS)) for port, message in found if port == "puppets"]


def stamps(found: Stream, port: str) -> list[int]:
    return [stamp_ns(message) for name, message in found if name == port]


def test_the_order_of_image_and_detection_does_not_matter(images: list[Any], detections: dict[int, Any]) -> None:
    found = []
    for first in ("image", "detections"):
        component = tracker()
        component.set_expected("detections", True)
        found.append(puppets(drive(component, interleaved(images, detections, first))))
        assert component.counters["images without detection"] == len(images) - len(detections)
    assert len(found[0]) == len(images)
    assert found[0] == found[1]


def test_an_image_waits_for_its_detection_but_not_for_ever(images: list[Any], detections: dict[int, Any]) -> None:
    component = tracker(wait=2)
    component.set_expected("detections", True)
    assert component.handle("image", images[0]) == []
    assert component.handle("image", images[1]) == []
    first = component.handle("detections", detections[stamp_ns(images[0])])
    assert stamps(first, "puppets") == [stamp_ns(images[0])]
    assert len(first[0][1].puppets) == 1
    assert component.handle("image", images[2]) == []
    assert stamps(component.handle("image", images[3]), "puppets") == [stamp_ns(images[1])]
    assert component.handle("detections", detections[stamp_ns(images[1])]) == []
    assert component.counters["late detections"] == 1
    assert stamps(component.flush(), "puppets") == [stamp_ns(image) for image in images[2:4]]


def test_nothing_waits_when_nobody_detects(images: list[Any]) -> None:
    component = tracker(**{"detection.source": "own"})
    for image in images[:3]:
        ((port, message),) = component.handle("image", image)
        assert (port, message.header) == ("puppets", image.header)
        assert message.puppets == []


def test_lazy_outputs_are_made_on_demand_only(images: list[Any], detections: dict[int, Any]) -> None:
    stream = interleaved(images[:2], detections, "detections")
    quiet = tracker()
    assert {port for port, _ in drive(quiet, stream)} == {"puppets"}
    loud = tracker(overlay_max_side=96)
    for port in loud.outputs:
        if port.lazy:
            loud.set_subscribed(port.name, True)
    made = dict(drive(loud, stream))
    assert set(made) == {port.name for port in loud.outputs}
    assert decode_image(made["overlay"]).shape == (96, 77, 3)
    assert decode_image(made["puppet_flow/preview"]).shape == (240, 2 * 192, 3)
    assert stamp_ns(made["flow/preview"]) == stamp_ns(images[0])
    with pytest.raises(ValueError, match="no port 'hat'"):
        loud.set_subscribed("hat", True)


def test_the_flow_node_and_the_tracker_agree(images: list[Any], detections: dict[int, Any]) -> None:
    """Flow that comes as messages carries the puppets to where the flow computed inside does."""
    flows = OpticalFlowComponent(FlowSettings(), FACTORY)
    joined, alone = tracker(), tracker()
    for port in ("flow/forward", "flow/backward", "detections"):
        joined.set_expected(port, True)
    stream: Stream = []
    for image in images[:5]:
        stream += [("image", image), *flows.handle("image", image)]
        if stamp_ns(image) in detections:
            stream.append(("detections", detections[stamp_ns(image)]))
    forward = [stamp_ns(message) for port, message in stream if port == "flow/forward"]
    backward = [stamp_ns(message) for port, message in stream if port == "flow/backward"]
    assert forward == [stamp_ns(image) for image in images[:4]]
    assert backward == [stamp_ns(image) for image in images[1:5]]
    alone.set_expected("detections", True)
    own = drive(alone, [item for item in stream if not item[0].startswith("flow")])
    assert puppets(drive(joined, stream)) == puppets(own)
    assert joined.counters["images without flow"] == 0


def test_a_flow_topic_that_stops_is_told_of_and_made_up_for(images: list[Any], detections: dict[int, Any]) -> None:
    flows = OpticalFlowComponent(FlowSettings(), FACTORY)
    follower = tracker()
    for port in ("flow/forward", "flow/backward", "detections"):
        follower.set_expected(port, True)
    stream: Stream = []
    for number, image in enumerate(images[:6]):
        made = flows.handle("image", image)
        stream += [("image", image), *(made if number < 3 else [])]
        if stamp_ns(image) in detections:
            stream.append(("detections", detections[stamp_ns(image)]))
    found = puppets(drive(follower, stream))
    assert len(found) == 6
    assert follower.counters["images without flow"] == 3
    assert [text for text in follower.report.drain_warnings() if "without the flow" in text]


def test_flow_points_along_the_motion_and_restarts_after_a_jump_back() -> None:
    rng = np.random.default_rng(0)
    texture = np.repeat(np.repeat(rng.integers(0, 255, (40, 50), dtype=np.uint8), 4, 0), 4, 1)
    pictures = [texture[8:136, 8 - shift : 168 - shift] for shift in (0, 3, 6)]
    component = OpticalFlowComponent(FlowSettings(), FACTORY)
    frames = [
        make_image(FACTORY, make_header(FACTORY, stamp, "cam"), picture, "mono8")
        for stamp, picture in zip((10, 20, 5), pictures, strict=True)
    ]
    assert component.handle("image", frames[0]) == []
    made = dict(component.handle("image", frames[1]))
    for port, motion in (("flow/forward", (3, 0)), ("flow/backward", (-3, 0))):
        np.testing.assert_allclose(np.median(decode_flow(made[port]), axis=(0, 1)), motion, atol=0.2)
    assert component.handle("image", frames[2]) == []
    assert "the flow restarts" in component.report.drain_warnings()[0]
    assert component.report.drain_warnings() == []


def test_a_recording_that_starts_again_gives_the_same_joints(images: list[Any], detections: dict[int, Any]) -> None:
    component = tracker()
    component.set_expected("detections", True)
    once = interleaved(images, detections, "image")
    found = [message for port, message in drive(component, once + once) if port == "puppets"]
    assert len(found) == 2 * len(images)
    for first, second in zip(found[: len(images)], found[len(images) :], strict=True):
        places = [[(j.x, j.y) for p in message.puppets for j in p.joints] for message in (first, second)]
        np.testing.assert_array_equal(places[0], places[1])
        assert [p.id for p in first.puppets] != [p.id for p in second.puppets]


def test_bad_images_are_said_once_and_do_not_stop_the_others(images: list[Any]) -> None:
    component = tracker()
    broken = FACTORY.make(COMPRESSED_IMAGE, header=images[1].header, format="jpeg", data=np.zeros(9, np.uint8))
    found = drive(component, [("image", images[0]), ("image", broken), ("image", broken), ("image", images[2])])
    assert stamps(found, "puppets") == [stamp_ns(images[0]), stamp_ns(images[2])]
    assert component.counters["unusable"] == 2
    assert component.report.drain_warnings() == ["a compressed image of format 'jpeg' and 9 bytes cannot be decoded"]


@pytest.mark.parametrize("names", ["", "cam1", "cam1, cam1"])
def test_a_hull_needs_two_names(names: str) -> None:
    with pytest.raises(InputError, match="needs two or more different names"):
        VisualHullComponent(VisualHullSettings(cameras=names), FACTORY)


@pytest.mark.slow
def test_the_order_of_the_inputs_of_a_hull_does_not_matter(recorded: dict[str, list[Any]]) -> None:
    stream = hull_stream(recorded)
    settings = VisualHullSettings(cameras="cam1,cam2", hull_every=1)
    found = []
    for order in (stream, stream[:3] + stream[:2:-1]):
        # Each input on its own comes in the order of its stamps, as a topic does.
        ports = [port for port, _ in order]
        queues = {port: [message for name, message in stream if name == port] for port in set(ports)}
        component = VisualHullComponent(settings, FACTORY)
        made = drive(component, [(port, queues[port].pop(0)) for port in ports])
        found.append([(port, message.header, getattr(message, "data", b"")) for port, message in made])
        assert component.counters["sets"] == 2
        assert [port for port, _ in made] == ["hull/joints", "hull"] * 2
    assert [item[:2] for item in found[0]] == [item[:2] for item in found[1]]
    for one, other in zip(found[0], found[1], strict=True):
        np.testing.assert_array_equal(one[2], other[2])


@pytest.mark.parametrize(
    ("skip", "sentence"),
    [
        (
            ("/tf_static",),
            "cam2: /tf and /tf_static do not connect 'cam2_optical_frame' with 'cam1_opt",
        ),
        (("cam2/camera_info",), "no camera_info came yet on cam2/camera_info"),
    ],
)
def test_a_hull_says_what_it_misses(recorded: dict[str, list[Any]], skip: tuple[str, ...], sentence: str) -> None:
    component = VisualHullComponent(VisualHullSettings(cameras="cam1,cam2", hull_every=1), FACTORY)
    assert drive(component, hull_stream(recorded, skip)) == []
    (warning,) = component.report.drain_warnings()
    assert warning.startswith(sentence)
    assert component.counters["unusable"] == 2


def test_frames_that_come_after_the_first_images_place_the_hull(recorded: dict[str, list[Any]]) -> None:
    component = VisualHullComponent(VisualHullSettings(cameras="cam1,cam2", hull_every=1), FACTORY)
    stream = hull_stream(recorded)
    assert drive(component, [item for item in stream if item[0] != "/tf_static"]) == []
    component.reset()
    assert {message.header.frame_id for _, message in drive(component, stream)} == {"world"}


def test_silhouettes_go_on_without_a_camera_that_is_dead_or_not_calibrated(recorded: dict[str, list[Any]]) -> None:
    stream = hull_stream(recorded)
    for spoilt in ("dead", "uncalibrated"):
        component = VisualHullComponent(VisualHullSettings(cameras="cam3,cam1,cam2"), FACTORY)
        component.set_subscribed("silhouettes", True)
        third = [(port.replace("cam2", "cam3"), message) for port, message in stream if port.startswith("cam2")]
        info = FACTORY.make(CAMERA_INFO, header=third[0][1].header, width=192, height=240)
        third[0] = ("cam3/camera_info", info)
        made = drive(component, stream + (third if spoilt == "uncalibrated" else []))
        assert [port for port, _ in made] == ["silhouettes"] * 2
        assert all([each.camera for each in message.silhouettes] == ["cam1", "cam2"] for _, message in made)
        warnings = component.report.drain_warnings()
        expected = ["cam3: the camera_info is uncalibrated (k is all zero); publish a calibrated camera_info"]
        assert warnings == (expected if spoilt == "uncalibrated" else [])


def test_silhouettes_are_made_only_when_somebody_listens(recorded: dict[str, list[Any]]) -> None:
    component = VisualHullComponent(VisualHullSettings(cameras="cam1,cam2"), FACTORY)
    assert drive(component, hull_stream(recorded)) == []
    assert component.counters["sets"] == 2


def test_silhouettes_that_cannot_be_used_are_one_sentence(recorded: dict[str, list[Any]]) -> None:
    hull = VisualHullComponent(VisualHullSettings(cameras="cam1,cam2"), FACTORY)
    hull.set_subscribed("silhouettes", True)
    first, second = (message for _, message in drive(hull, hull_stream(recorded)))
    fitter = BodyFitterComponent(BodyFitterSettings.from_mapping({"silhouettes.gauss_newton_steps": 2}), FACTORY)
    first.silhouettes[1].info.width = 100
    made = dict(fitter.handle("silhouettes", first))
    assert made["bodies"].bodies == [] and made["bodies"].header == first.header
    assert fitter.report.drain_warnings() == ["cam2: the mask is 192 x 240, its camera_info says 100 x 240"]
    made = dict(fitter.handle("silhouettes", second))
    assert [body.id for body in made["bodies"].bodies] == ["b1"]
    assert (fitter.counters["bodies"], fitter.counters["unusable"]) == (1, 1)


def test_the_bodies_of_one_instant_come_together_in_the_order_of_their_ids(recorded: dict[str, list[Any]]) -> None:
    hull = VisualHullComponent(VisualHullSettings(cameras="cam1,cam2"), FACTORY)
    hull.set_subscribed("silhouettes", True)
    first, second = (message for _, message in drive(hull, hull_stream(recorded)))
    assert first.people == ["b1"]

    def named(message: Any, identity: str, people: list[str]) -> Any:
        copy = deepcopy(message)
        copy.person.id, copy.people = identity, people
        return copy

    both = ["b1", "b2"]
    fitter = BodyFitterComponent(BodyFitterSettings.from_mapping({"silhouettes.gauss_newton_steps": 2}), FACTORY)
    assert fitter.handle("silhouettes", named(first, "b2", both)) == []
    made = dict(fitter.handle("silhouettes", named(first, "b1", both)))
    assert [body.id for body in made["bodies"].bodies] == both
    # Of the next instant one set is lost: who is there comes out when something newer comes, or at the end.
    assert fitter.handle("silhouettes", named(second, "b2", both)) == []
    made = dict(fitter.flush())
    assert [body.id for body in made["bodies"].bodies] == ["b2"] and made["bodies"].header == second.header
    fitter.handle("silhouettes", named(first, "b1", both))
    made = dict(fitter.handle("silhouettes", named(second, "b1", ["b1"])))
    assert made["bodies"].header == second.header
    assert fitter.counters["bodies"] == 5


def test_a_hull_finds_a_second_person_across_the_cameras(recorded: dict[str, list[Any]]) -> None:
    """Another puppet, 0.9 m beside the first in space: both have joints under their ids, one has a silhouette."""
    stream, shift = hull_stream(recorded), np.array([0.0, 0.9, 0.0])
    settings = VisualHullSettings.from_mapping({"cameras": "cam1,cam2", "hull_every": 1, "association.confirm_sets": 1})
    alone = VisualHullComponent(settings, FACTORY)
    joints = decode_body_joints(next(m for port, m in drive(alone, stream) if port == "hull/joints").bodies[0])
    cameras = alone._builder.cameras
    crowd = []
    for port, message in stream:
        copy = deepcopy(message)
        if port.endswith("/puppets"):
            other = deepcopy(copy.puppets[0])
            other.id, other.parts, other.confidence = "other", [], 0.1
            for joint in other.joints:
                place = np.array(joints[joint.name][:3]) + shift if joint.name in joints else np.full(3, np.nan)
                (joint.x, joint.y), _ = cameras[port.split("/")[0]].project(place)
            copy.puppets.append(other)
        crowd.append((port, copy))
    component = VisualHullComponent(settings, FACTORY)
    component.set_subscribed("silhouettes", True)
    made = drive(component, crowd)
    found = next(message for port, message in made if port == "hull/joints")
    assert [body.id for body in found.bodies] == ["b1", "b2"]
    places = {body.id: decode_body_joints(body) for body in found.bodies}
    main, other = (min(places.values(), key=lambda each: sign * each["neck"][1]) for sign in (1, -1))
    for name in set(main) & set(other):
        np.testing.assert_allclose(np.subtract(other[name][:3], main[name][:3]), shift, atol=0.03)
    assert len({m.person.id for port, m in made if port == "silhouettes"}) == 1


def test_a_black_image_is_one_sentence_and_the_next_is_used(images: list[Any]) -> None:
    component = tracker(**{"detection.source": "none"})
    black = make_image(FACTORY, images[1].header, np.full((60, 80, 3), 3, np.uint8), "rgb8")
    found = drive(component, [("image", black), ("image", images[2])])
    assert stamps(found, "puppets") == [stamp_ns(images[1]), stamp_ns(images[2])]
    assert component.counters["black images"] == 1
    (said,) = [text for text in component.report.drain_warnings() if "black" in text]
    assert said == "an image is black, and nobody can be found in it: see to the exposure and the lens cover"
