# SPDX-License-Identifier: Apache-2.0
"""What is handed to the Rerun SDK, by a stand-in with the signatures of rerun-sdk 0.41.

The package itself is 0.7 GB installed and in no requirements of the tests; where it is installed the stand-in is held
against it, and a recording is written.
"""

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.report.rerun_file import write_fits, write_replay

type Replay = Callable[..., tuple[Path, Path]]

USED = {
    "Mesh3D": ("vertex_positions", "triangle_indices", "vertex_colors"),
    "Points3D": ("positions", "radii", "colors", "labels", "show_labels"),
    "Points2D": ("positions", "radii", "colors", "labels", "show_labels"),
    "LineStrips2D": ("strips", "colors"),
    "EncodedImage": ("contents", "media_type"),
    "Image": ("image",),
    "Transform3D": ("translation", "mat3x3"),
    "Pinhole": ("image_from_camera", "resolution"),
    "Clear": ("recursive",),
}
START = 5_000_000_000


class Stream:
    """Keeps what is logged: place -> [(stamp in ns or None when it is there always, what)]."""

    def __init__(self, application_id: str) -> None:
        self.logged: dict[str, list[tuple[int | None, Any]]] = {}
        self.stamp = 0
        streams.append(self)

    def save(self, path: str) -> None:
        Path(path).write_bytes(b"rrd")

    def set_time(self, timeline: str, *, timestamp: np.datetime64) -> None:
        self.stamp = int(timestamp.astype("datetime64[ns]").astype(np.int64))

    def log(self, entity_path: str, entity: Any, *, static: bool = False) -> None:
        self.logged.setdefault(entity_path, []).append((None if static else self.stamp, entity))

    def flush(self) -> None:
        pass

    def disconnect(self) -> None:
        pass


streams: list[Stream] = []


def archetype(name: str) -> Callable[..., SimpleNamespace]:
    def make(*values: Any, **named: Any) -> SimpleNamespace:
        given = dict(zip(USED[name], values, strict=False)) | named
        assert set(given) <= set(USED[name]), f"{name} has no {set(given) - set(USED[name])}"
        return SimpleNamespace(kind=name, **given)

    return make


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> list[Stream]:
    """A module `rerun`, and the streams that were made with it."""
    module = ModuleType("rerun")
    values = {name: archetype(name) for name in USED}
    values["RecordingStream"] = Stream  # type: ignore[assignment]
    values["ViewCoordinates"] = SimpleNamespace(RIGHT_HAND_Z_UP=SimpleNamespace(kind="ViewCoordinates"))  # type: ignore[assignment]
    vars(module).update(values)
    monkeypatch.setitem(sys.modules, "rerun", module)
    streams.clear()
    return streams


def test_a_replay_has_images_joints_clouds_and_meshes(replay: Replay, tmp_path: Path, stand_in: list[Stream]) -> None:
    write_replay(*replay(), tmp_path / "deep" / "out.rrd")
    logged = stand_in[0].logged
    stamps = [START + k * 100_000_000 for k in range(5)]
    for name in ("front", "side"):
        place = f"world/cameras/{name}"
        assert [(at, one.kind) for at, one in logged[place]] == [(None, "Transform3D"), (None, "Pinhole")]
        assert [at for at, _ in logged[f"{place}/image"]] == stamps
        assert all(one.contents[:2] == b"\xff\xd8" for _, one in logged[f"{place}/image"])
        assert [at for at, _ in logged[f"{place}/image/puppets/a1/joints"]] == stamps
        assert len(logged[f"{place}/image/puppets/a1/outlines"][0][1].strips[0]) == 5
    transform, pinhole = (one for _, one in logged["world/cameras/front"])
    np.testing.assert_allclose(transform.translation, [4, 0, 0.9], atol=1e-9)
    # A point before the camera, in the middle of its image.
    np.testing.assert_allclose(transform.mat3x3 @ [0, 0, 4] + transform.translation, [0, 0, 0.9], atol=1e-9)
    assert pinhole.resolution == [120, 160]
    meshes = logged["world/bodies/a1"]
    assert [(at, one.kind) for at, one in meshes] == [(stamp, "Mesh3D") for stamp in stamps[::2]]
    assert meshes[0][1].vertex_positions.shape == (8, 3) and meshes[0][1].triangle_indices.shape == (12, 3)
    assert len(logged["world/bodies/a1/joints"][0][1].labels) == 12
    assert [at for at, _ in logged["world/hull"]] == stamps[::2]


def test_fits_are_meshes_with_their_scans(tmp_path: Path, stand_in: list[Stream]) -> None:
    model = StitchedPuppet.load()
    np.savez(
        tmp_path / "a.npz",
        vertices=model.vertices(model.rest_state()).astype(np.float32),
        faces=model.faces,
        part_of_vertex=model.part_of_vertex,
        part_names=np.array(model.tree.names),
        joints=np.zeros((2, 3)),
        joint_names=np.array(["left_knee", "neck"]),
    )
    write_fits([("a", np.array([[0.0, 1, 2], [np.nan, 0, 0]]), tmp_path / "a.npz")], tmp_path / "fits.rrd")
    logged = stand_in[0].logged
    ((at, mesh),) = logged["world/a/body"]
    assert at is None and mesh.vertex_colors.shape == mesh.vertex_positions.shape == (len(model.part_of_vertex), 3)
    assert logged["world/a/scan"][0][1].positions.tolist() == [[0, 1, 2]]
    assert logged["world/a/body/joints"][0][1].labels == ["left_knee", "neck"]


@pytest.mark.parametrize("verb", ["fit", "replay"])
def test_without_the_package_it_is_said_before_the_work(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    words = [verb, "nothing.ply", "--out", str(tmp_path / "out"), "--rerun", str(tmp_path / "out.rrd")]
    assert main(words) == 2
    assert "pip install 'flowing_puppet_ros[rerun]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_stand_in_is_as_the_package(replay: Replay, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun")
    for name, names in USED.items():
        assert set(names) <= set(inspect.signature(getattr(rerun, name)).parameters), name
    write_replay(*replay(), tmp_path / "out.rrd")
    assert (tmp_path / "out.rrd").stat().st_size > 10_000
