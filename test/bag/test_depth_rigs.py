# SPDX-License-Identifier: Apache-2.0
"""Which depth cameras of a recording are taken together: those that /tf_static connects and whose views meet."""

from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.depth_topics import ImageSample
from flowing_puppet_ros.bag.replay.build import build_graph
from flowing_puppet_ros.bag.replay.graph import Graph
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.stream.messages.geometry import FrameTree, make_camera_info, make_header, make_transform
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, IMAGE, TRANSFORMS

FACTORY = BagMessageFactory()
MATRIX = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


def looking_along(yaw: float) -> np.ndarray:
    """Return the axes (3, 3), as columns right, down and forward, of a level camera; yaw in degrees from x to y."""
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    return np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])


def graph_of(places: list[tuple[tuple[float, float, float], float]], linked: int) -> Graph:
    """Return the graph of depth cameras at places with yaws, of which so many have a transform."""
    frames, topics = FrameTree(), dict[str, str]()
    samples, infos = dict[str, ImageSample](), dict[str, Any]()
    header = make_header(FACTORY, 0, "map")
    links = [
        make_transform(FACTORY, header, f"eye{number}", np.array(place), looking_along(yaw))
        for number, (place, yaw) in enumerate(places[:linked])
    ]
    frames.add(FACTORY.make(TRANSFORMS, transforms=links))
    for number in range(len(places)):
        image, info = f"/cam{number}/depth/image_raw", f"/cam{number}/depth/camera_info"
        topics |= {image: IMAGE, info: CAMERA_INFO}
        samples[image] = ImageSample("16UC1", f"eye{number}", (320, 240))
        own = make_header(FACTORY, 0, f"eye{number}")
        infos[info] = make_camera_info(FACTORY, own, (320, 240), MATRIX, np.zeros(5))
    return build_graph(topics, samples, frames, infos, {}, FACTORY)


def rigs(graph: Graph) -> list[Any]:
    return [instance.component.settings.values()["rig.cameras"] for instance in graph.instances]


@pytest.mark.slow
def test_cameras_that_face_each_other_are_fitted_together() -> None:
    graph = graph_of([((0, 0, 1), 0.0), ((5, 0.5, 1), 180.0)], linked=2)
    assert rigs(graph) == ["cam0/depth,cam1/depth"]
    (fitter,) = graph.instances
    assert fitter.resolve("cam1/depth/depth") == "/cam1/depth/image_raw"
    assert fitter.resolve("cam1/depth/camera_info") == "/cam1/depth/camera_info"
    assert fitter.resolve("bodies") == "/bodies"


@pytest.mark.slow
def test_cameras_that_look_apart_or_have_no_transform_are_fitted_one_by_one() -> None:
    away = graph_of([((0, 0, 1), 0.0), ((-0.3, 0, 1), 180.0)], linked=2)
    assert rigs(away) == ["", ""]
    unknown = graph_of([((0, 0, 1), 0.0), ((5, 0.5, 1), 180.0)], linked=1)
    assert rigs(unknown) == ["", ""]


@pytest.mark.slow
def test_a_third_camera_that_looks_elsewhere_has_a_fitter_of_its_own() -> None:
    graph = graph_of([((0, 0, 1), 0.0), ((5, 0.5, 1), 180.0), ((0, 0, 1), 180.0)], linked=3)
    assert rigs(graph) == ["cam0/depth,cam1/depth", ""]


def joined_graph(colour: list[tuple[tuple[float, float, float], float]]) -> Graph:
    """Return the graph of a depth camera with colour at the origin, which looks along x, and of colour cameras."""
    frames, topics = FrameTree(), {"/cam/depth/image_raw": IMAGE, "/cam/depth/camera_info": CAMERA_INFO}
    header = make_header(FACTORY, 0, "map")
    places = {"cam/color": ((0.0, 0.0, 1.0), 0.0), **{f"eye{number}": place for number, place in enumerate(colour)}}
    infos, links = dict[str, Any](), []
    for name, (place, yaw) in places.items():
        frame = name.partition("/")[0]
        links.append(make_transform(FACTORY, header, frame, np.array(place), looking_along(yaw)))
        topics |= {f"/{name}/image_raw": IMAGE, f"/{name}/camera_info": CAMERA_INFO}
        own = make_header(FACTORY, 0, frame)
        infos[f"/{name}/camera_info"] = make_camera_info(FACTORY, own, (320, 240), MATRIX, np.zeros(5))
    infos["/cam/depth/camera_info"] = infos["/cam/color/camera_info"]
    frames.add(FACTORY.make(TRANSFORMS, transforms=links))
    samples = {"/cam/depth/image_raw": ImageSample("16UC1", "cam", (320, 240))}
    return build_graph(topics, samples, frames, infos, {}, FACTORY)


def fitters(graph: Graph) -> list[Any]:
    return [instance for instance in graph.instances if instance.name.rpartition("/")[2] == "body_fitter"]


@pytest.mark.slow
def test_a_depth_camera_among_colour_cameras_gives_one_body_with_their_silhouettes() -> None:
    (fitter,) = fitters(joined_graph([((5, 0.5, 1), 180.0), ((2.5, -3, 1), 90.0)]))
    assert fitter.component.settings.rig.cameras == "cam/depth"
    assert fitter.resolve("silhouettes") == "/silhouettes" and fitter.resolve("bodies") == "/bodies"
    assert fitter.resolve("cam/depth/depth") == "/cam/depth/image_raw"


@pytest.mark.slow
@pytest.mark.parametrize(
    "colour", [[((0, -0.12, 1), 0.0)], [((5, 0, 1), 0.0), ((5, 1, 1), 0.0)]], ids=["beside it", "looking elsewhere"]
)
def test_silhouettes_that_show_no_other_side_are_not_joined_with_depth(colour: Any) -> None:
    graph = joined_graph(colour)
    assert [fitter.component.settings.rig.cameras for fitter in fitters(graph)] == ["", ""]
