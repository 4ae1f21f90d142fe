# SPDX-License-Identifier: Apache-2.0
"""Recorded depth images drive the body fitter as they do live; which topics are taken for depth, and what is said."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.bag.depth_topics import ImageSample
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.build import build_graph
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import read_recording, to_cloud
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.report.data import gather_data
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import decode_cloud, make_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import BODIES, CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD

pytestmark = pytest.mark.slow

FACTORY = BagMessageFactory()
FAST = {
    "fitter.local_particles": 6, "fitter.local_iterations": 1, "fitter.gauss_newton_steps": 6,
    "fitter.max_points": 1500, "fitter.max_limb_repairs": 0, "fitter.joint_weight": 0.0,
}  # fmt: skip
FOCAL, HEIGHT, WIDTH = 200.0, 240, 320
AWAY = 2.6
TENTH = 100_000_000
# Person: x ahead, y left, z up. The camera stands before them: x right (their left), y down, z forward (their back).
TO_CAMERA = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])


def in_camera(points: np.ndarray, aside: float) -> np.ndarray:
    """Return places of the person's frame in the camera's, metres."""
    return np.asarray((points + np.array([0, aside, 0])) @ TO_CAMERA.T + np.array([0, 0, AWAY]))


def depth_of(points: np.ndarray) -> np.ndarray:
    """Return what a depth camera sees of points (N,3): metres (H,W), 0 where it sees nothing."""
    z = points[:, 2]
    columns = np.rint(points[:, 0] / z * FOCAL + (WIDTH - 1) / 2).astype(int)
    rows = np.rint(points[:, 1] / z * FOCAL + (HEIGHT - 1) / 2).astype(int)
    seen = (columns >= 0) & (columns < WIDTH) & (rows >= 0) & (rows < HEIGHT)
    nearest = np.full((HEIGHT, WIDTH), np.inf)
    np.minimum.at(nearest, (rows[seen], columns[seen]), z[seen])
    return np.where(np.isfinite(nearest), nearest, 0.0)


def info(stamp: int) -> Any:
    k = np.array([FOCAL, 0, (WIDTH - 1) / 2, 0, FOCAL, (HEIGHT - 1) / 2, 0, 0, 1.0])
    return FACTORY.make(
        CAMERA_INFO, header=make_header(FACTORY, stamp, "eye"), width=WIDTH, height=HEIGHT, k=k, p=np.zeros(12)
    )


def image(stamp: int, metres: np.ndarray, encoding: str) -> Any:
    pixels = np.rint(metres * 1000).astype(np.uint16) if encoding == "16UC1" else metres.astype(np.float32)
    return make_image(FACTORY, make_header(FACTORY, stamp, "eye"), pixels, encoding)


def believed(stamp: int, joints: np.ndarray) -> Any:
    """Return the joints at which a fit starts, for the search from nothing takes seconds; 8 cm behind the true ones."""
    points = [FACTORY.make("geometry_msgs/msg/Point", x=x, y=y, z=z + 0.08) for x, y, z in joints.tolist()]
    start = [
        FACTORY.make("flowing_puppet_msgs/msg/BodyJoint", name=name, confidence=1.0, position=point)
        for name, point in zip(joints_of(), points, strict=True)
    ]
    body = FACTORY.make("flowing_puppet_msgs/msg/Body", id="someone", joints=start)
    return FACTORY.make(BODIES, header=make_header(FACTORY, stamp, "eye"), bodies=[body])


def recorded(path: Path, messages: list[tuple[str, str, Any]]) -> Path:
    """Write (topic, type, message) a tenth of a second apart."""
    with BagWriter(path) as writer:
        for topic, kind in dict.fromkeys((topic, kind) for topic, kind, _ in messages):
            writer.add_topic(topic, kind, "sensor")
        for k, (topic, _, message) in enumerate(messages):
            writer.write(topic, k * TENTH, message)
    return path


def compressed(message: Any) -> Any:
    """Return a 16UC1 image as the transport `compressedDepth` sends it."""
    pixels = message.data.view("<u2").reshape(message.height, message.width)
    data = np.concatenate([np.zeros(12, np.uint8), cv2.imencode(".png", pixels)[1].reshape(-1)])
    return FACTORY.make(COMPRESSED_IMAGE, header=message.header, format="16UC1; compressedDepth png", data=data)


def test_a_depth_image_that_was_also_recorded_compressed_is_used_once() -> None:
    image, info_topic = "/rig/depth/image_rect", "/rig/depth/camera_info"
    packed = f"{image}/compressedDepth"
    for recorded, fed in ({packed: COMPRESSED_IMAGE, image: IMAGE}, image), ({packed: COMPRESSED_IMAGE}, packed):
        topics = recorded | {info_topic: CAMERA_INFO}
        samples = dict.fromkeys(recorded, ImageSample("16UC1", "eye", (WIDTH, HEIGHT)))
        graph = build_graph(topics, samples, FrameTree(), {info_topic: info(0)}, {"body_fitter": FAST}, FACTORY)
        routes = {topic: [port for _, port in found] for topic, found in graph.find_routes(topics).items()}
        assert [topic for topic in recorded if routes.get(topic) == ["depth"]] == [fed]


@pytest.mark.parametrize(
    ("encoding", "name"),
    [("16UC1", "image_rect_raw"), ("32FC1", "depth_registered"), ("16UC1", "image_rect_raw/compressedDepth")],
)
def test_a_recorded_depth_camera_gives_the_bodies_that_it_gives_live(encoding: str, name: str, tmp_path: Path) -> None:
    surface, _ = cloud_of(joints_of(), 60_000)
    truth = [in_camera(np.stack(list(joints_of().values())), 0.02 * k) for k in range(2)]
    stream: list[tuple[str, str, Any]] = []
    for k in range(2):
        seen = image(k * TENTH, depth_of(in_camera(surface, 0.02 * k)), encoding)
        three = [
            ("/rig/depth/camera_info", CAMERA_INFO, info(k * TENTH)),
            (f"/rig/depth/{name}", *((COMPRESSED_IMAGE, compressed(seen)) if "/" in name else (IMAGE, seen))),
            ("/rig/depth/initial", BODIES, believed(k * TENTH, truth[k])),
        ]
        stream += three if k else three[::-1]
    bag = recorded(tmp_path / "in.mcap", stream)
    summary = replay(bag, tmp_path / "out.mcap", ReplayOptions(settings={"body_fitter": FAST}, progress=False))
    assert summary["warnings"] == []
    with open_bag(tmp_path / "out.mcap") as out:
        found = list(out.messages(["/rig/depth/bodies"]))
        assert out.details["/rig/depth/camera_info"].count == 2, "a viewer needs the calibration"
    ports = {f"/rig/depth/{name}": "depth"}
    inputs = [(ports.get(topic, topic.rpartition("/")[2]), message) for topic, _, message in stream]
    with one_blas_thread():  # as in a node from its start: sums depend on the number of threads
        live = BodyFitterComponent(BodyFitterSettings.from_mapping(FAST), FACTORY)
        live.set_expected("initial", True)
        made = [made for port, message in inputs for made in live.handle(port, message)] + live.flush()
    expected = [message for port, message in made if port == "bodies"]
    assert [record.raw for record in found] == [bytes(typestore().serialize_cdr(one, BODIES)) for one in expected]
    assert len(expected) == 2
    for bodies, joints in zip(expected, truth, strict=True):
        (body,) = bodies.bodies
        assert (body.id, bodies.header.frame_id) == ("someone", "eye")
        places = {joint.name: [joint.position.x, joint.position.y, joint.position.z] for joint in body.joints}
        common = [(place, places[key]) for key, place in zip(joints_of(), joints, strict=True) if key in places]
        off = np.median([found - true for true, found in common], axis=0)
        assert len(common) > 12 and np.abs(off).max() < 0.04, "where the depth has it, not where it was believed"
    if encoding == "16UC1":
        scene = gather_data(bag, tmp_path / "out.mcap").scene
        assert scene is not None and len(scene["frames"]) == 2
        assert all(len(frame["points"]) > 1000 for frame in scene["frames"]), (
            "a report shows the bodies in their points"
        )


NOTHING = np.zeros((HEIGHT, WIDTH))


def warnings_of(folder: Path, *messages: tuple[str, str, Any]) -> tuple[list[str], dict[str, int]]:
    """Return what a replay of blank images says, and how many messages of each topic it makes."""
    summary = replay(recorded(folder / "in.mcap", list(messages)), folder / "out.mcap", ReplayOptions(progress=False))
    return [text for text in summary["warnings"] if "no finite point" not in text], summary["messages"]


def test_depth_images_named_as_pictures_are_no_camera(tmp_path: Path) -> None:
    picture = make_image(FACTORY, make_header(FACTORY, 0, "eye"), np.full((32, 32, 3), 90, np.uint8), "rgb8")
    said, made = warnings_of(
        tmp_path,
        ("/rgb/image_raw", IMAGE, picture),
        ("/depth/image_raw", IMAGE, image(0, NOTHING, "16UC1")),
        ("/depth/image_rect", IMAGE, image(0, NOTHING, "32FC1")),
        ("/depth/camera_info", CAMERA_INFO, info(0)),
    )
    assert said == ["/depth/image_rect is used without colour: there is no camera_info for /rgb/image_raw"]
    assert (made["/rgb/puppets"], made["/depth/bodies"]) == (1, 1), "one of the two depth images, the rectified one"
    assert "/depth/puppets" not in made


def test_images_that_may_be_depth_are_told_of_with_the_way_out(tmp_path: Path) -> None:
    stream = [
        ("/oak/stereo/image_raw", IMAGE, image(0, NOTHING, "16UC1")),
        ("/oak/stereo/camera_info", CAMERA_INFO, info(0)),
    ]
    bag = recorded(tmp_path / "in.mcap", stream)
    with pytest.raises(
        InputError, match=r"no topic can be used.*holds 16UC1 images and may be depth: --topic-map "
    ) as told:
        replay(bag, tmp_path / "out.mcap", ReplayOptions(progress=False))
    old, new = str(told.value).rpartition("--topic-map ")[2].split()[0].split(":=")
    summary = replay(bag, tmp_path / "out.mcap", ReplayOptions(topic_map={old: new}, progress=False))
    assert summary["messages"]["/oak/stereo/bodies"] == 1


def test_depth_without_its_calibration_is_told_of(tmp_path: Path) -> None:
    cloud = make_cloud(FACTORY, make_header(FACTORY, 0, "lidar"), np.zeros((0, 3)))
    blank = image(0, NOTHING, "16UC1")
    said, made = warnings_of(tmp_path, ("/lidar/points", POINT_CLOUD, cloud), ("/depth/image", IMAGE, blank))
    assert said == [
        "no body is fitted to the depth images on /depth/image (320x240, frame 'eye'): there is no /depth/camera_info, "
        "nor any other camera_info; record it with the images"
    ]
    assert made["/lidar/bodies"] == 1 and "/depth/bodies" not in made


def of_camera(frame: str, width: int = WIDTH) -> Any:
    message = info(0)
    message.header.frame_id, message.width = frame, width
    return message


@pytest.mark.parametrize("name", ["image_raw", "image_raw/compressedDepth", "image_raw/compressed"])
def test_registered_depth_takes_the_calibration_of_its_frame_and_size(name: str, tmp_path: Path) -> None:
    points = np.array([[0.0, 0, 2.0], [0.5, -0.25, 2.0]])
    seen = image(0, depth_of(points), "16UC1")
    if "/" in name:
        seen = compressed(seen)
    if name.endswith("compressed"):
        seen.format, seen.data = "16UC1; png compressed ", seen.data[12:]
    bag = recorded(
        tmp_path / "in.mcap",
        [
            ("/cam/aligned_depth_to_color/" + name, COMPRESSED_IMAGE if "/" in name else IMAGE, seen),
            ("/cam/color/camera_info", CAMERA_INFO, of_camera("/eye")),
            ("/cam/depth/camera_info", CAMERA_INFO, of_camera("other_eye")),
            ("/cam/infra/camera_info", CAMERA_INFO, of_camera("eye", WIDTH // 2)),
            ("/other/color/camera_info", CAMERA_INFO, of_camera("eye")),
        ],
    )
    options = ReplayOptions(settings={"body_fitter": FAST | {"scene": False}}, progress=False)
    summary = replay(bag, tmp_path / "out.mcap", options)
    assert summary["warnings"][0] == (
        "the camera_info of the depth images on /cam/aligned_depth_to_color/image_raw is taken from "
        "/cam/color/camera_info (320x240, frame 'eye')"
    )
    assert summary["counters"]["cam/aligned_depth_to_color/image_raw/body_fitter"]["clouds"] == 1
    assert not [text for text in summary["warnings"] if "camera_info says" in text or "no camera_info" in text]
    with open_bag(bag) as given, open_bag(tmp_path / "out.mcap") as made:
        recording = read_recording(given, made)
        recording.cloud_topics["depth"] = f"/cam/aligned_depth_to_color/{name}"
        cloud = to_cloud(recording, recording.cloud_topics["depth"], next(given.messages([*given.topics][:1])).message)
    # A pixel is 1 cm at 2 m, and the middle of a pixel counts.
    np.testing.assert_allclose(sorted(decode_cloud(cloud)[0].tolist()), sorted(points.tolist()), atol=0.006)


def test_candidates_are_named_where_no_calibration_fits(tmp_path: Path) -> None:
    stream = [
        ("/cam/depth/image_raw", IMAGE, image(0, NOTHING, "16UC1")),
        ("/cam/color/camera_info", CAMERA_INFO, of_camera("color_eye")),
        ("/wrist/color/camera_info", CAMERA_INFO, of_camera("eye", 640)),
    ]
    with pytest.raises(InputError) as told:
        replay(recorded(tmp_path / "in.mcap", stream), tmp_path / "out.mcap", ReplayOptions(progress=False))
    assert (
        "/cam/color/camera_info (320x240, frame 'color_eye'), /wrist/color/camera_info (640x240, frame 'eye')"
        in str(told.value)
    )
    old, new = str(told.value).rpartition("--topic-map ")[2].split()[0].split(":=")
    assert (old, new) == ("/cam/color/camera_info", "/cam/depth/camera_info")
    options = ReplayOptions(topic_map={old: new}, progress=False)
    assert replay(tmp_path / "in.mcap", tmp_path / "out.mcap", options)["messages"]["/cam/depth/bodies"] == 1


def test_a_calibration_of_another_size_beside_the_images_gives_way_to_one_that_fits(tmp_path: Path) -> None:
    said, made = warnings_of(
        tmp_path,
        ("/cam/depth/image", IMAGE, image(0, NOTHING, "16UC1")),
        ("/cam/depth/camera_info", CAMERA_INFO, of_camera("eye", 424)),
        ("/cam/color/camera_info", CAMERA_INFO, of_camera("eye")),
    )
    assert "is taken from /cam/color/camera_info (320x240, frame 'eye')" in said[0]
    assert made["/cam/depth/bodies"] == 1


def test_stamps_of_the_calibration_that_differ_are_told_of_once(tmp_path: Path) -> None:
    stream: list[tuple[str, str, Any]] = []
    for k in range(3):
        stream += [
            ("/cam/depth/image", IMAGE, image(k * TENTH, NOTHING, "16UC1")),
            ("/cam/depth/camera_info", CAMERA_INFO, info(k * TENTH + 30_000_000)),
        ]
    summary = replay(recorded(tmp_path / "in.mcap", stream), tmp_path / "out.mcap", ReplayOptions(progress=False))
    said = [text for text in summary["warnings"] if "camera_info" in text]
    assert said == [
        "cam/depth/image/body_fitter: a depth image has no camera_info of its stamp: it is used with one whose stamp "
        "differs by 30 ms"
    ]
    counters = summary["counters"]["cam/depth/image/body_fitter"]
    assert (counters["clouds"], counters["depth with camera_info of another stamp"]) == (3, 3)


def test_a_camera_whose_points_were_recorded_is_not_fitted_twice(tmp_path: Path) -> None:
    cloud = make_cloud(FACTORY, make_header(FACTORY, 0, "eye"), np.zeros((0, 3)))
    said, made = warnings_of(
        tmp_path,
        ("/cam/depth/color/points", POINT_CLOUD, cloud),
        ("/cam/depth/image", IMAGE, image(0, NOTHING, "16UC1")),
        ("/cam/depth/camera_info", CAMERA_INFO, info(0)),
    )
    assert said == [
        "bodies are fitted to the points on /cam/depth/color/points, not to the depth images on /cam/depth/image too"
    ]
    assert made["/cam/depth/color/bodies"] == 1


def test_two_clouds_of_one_namespace_have_results_of_their_own(tmp_path: Path) -> None:
    cloud = make_cloud(FACTORY, make_header(FACTORY, 0, "eye"), np.zeros((0, 3)))
    _, made = warnings_of(tmp_path, ("/a/left", POINT_CLOUD, cloud), ("/a/right", POINT_CLOUD, cloud))
    assert (made["/a/bodies"], made["/a/right/bodies"]) == (1, 1)
