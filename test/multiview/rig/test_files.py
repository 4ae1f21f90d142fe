# SPDX-License-Identifier: Apache-2.0
"""Calibrations of other programs: hand-written files against cv2.projectPoints, round trips, and unusable ones."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rig.files import FORMS, read_rig, write_rig
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera, make_rig_camera
from flowing_puppet_ros.multiview.rig.video_size import fit_to_video

POINTS = np.array([[0.2, 0.1, 1.0], [-0.4, 0.3, 1.6], [0.1, -0.2, 0.2]])
# One camera 4 m along +x that looks back along -x, z up; another 3 m along +y that looks along -y.
ROTATIONS = {
    "cam1": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]),
    "cam2": np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]),
}
CENTRES = {"cam1": np.array([4.0, 0, 1]), "cam2": np.array([0.0, 3, 1])}
K = np.array([[800.0, 0, 320.25], [0, 810.0, 239.75], [0, 0, 1]])
LENS = (-0.1, 0.02, 0.001, -0.002)
SIZE = (640, 480)


def seen(name: str) -> np.ndarray:
    """Return the pixels of the points in a camera, by OpenCV."""
    rotation = ROTATIONS[name]
    return cv2.projectPoints(POINTS, cv2.Rodrigues(rotation)[0], -rotation @ CENTRES[name], K, np.array(LENS))[0][:, 0]


def assert_sees(rig: CameraRig, factor: float = 1.0, names: tuple[str, str] = ("cam1", "cam2")) -> None:
    assert list(rig.cameras) == list(names)
    for name, ours in zip(("cam1", "cam2"), names, strict=True):
        camera = rig.rescale(factor).cameras[ours].camera
        np.testing.assert_allclose(camera.project(POINTS)[0], seen(name), atol=1e-6)


def rows(matrix: np.ndarray) -> str:
    return str(matrix.tolist())


def test_toml_of_pose2sim_and_of_caliscope(tmp_path: Path) -> None:
    tables = [
        f"""[{key}]\n{extra}\nsize = [640, 480]\nmatrix = {rows(K)}\ndistortions = {list(LENS)}
rotation = {cv2.Rodrigues(ROTATIONS[name])[0].ravel().tolist()}
translation = {(-ROTATIONS[name] @ CENTRES[name]).tolist()}
"""
        for key, extra, name in (("int_1", 'name = "cam1"', "cam1"), ("cam_2", 'name = "cam2"', "cam2"))
    ]
    ignored = "[cam_3]\nignore = true\nmatrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
    (tmp_path / "Calib.toml").write_text("\n".join([*tables, ignored, "[metadata]\nerror = 0.5\n"]))
    assert_sees(read_rig(tmp_path / "Calib.toml"))
    assert_sees(read_rig(tmp_path))  # the only calibration in a folder


def test_qualisys_is_in_millimetres_and_64ths_of_a_pixel(tmp_path: Path) -> None:
    """A Qualisys camera has its own x to the right, y up, and looks along -z: the rows of its transform."""
    cameras = []
    for name, rotation in ROTATIONS.items():
        right, down, forward = rotation
        axes = " ".join(
            f'r{i + 1}{j + 1}="{v}"' for i, row in enumerate((right, -down, -forward)) for j, v in enumerate(row)
        )
        place = " ".join(f'{axis}="{1000 * v}"' for axis, v in zip("xyz", CENTRES[name], strict=True))
        cameras.append(
            f'<camera active="1" serial="{name}" viewrotation="0">'
            '<fov_video_max left="0" right="639" top="0" bottom="479"/>'
            f"<transform {axes} {place}/>"
            f'<intrinsic focalLengthU="{64 * 800}" focalLengthV="{64 * 810}" centerPointU="{64 * 320.25}"'
            f' centerPointV="{64 * 239.75}" radialDistortion1="-0.1" radialDistortion2="0.02" radialDistortion3="0"'
            ' tangentalDistortion1="0.001" tangentalDistortion2="-0.002"/></camera>'
        )
    inactive = '<camera active="0" serial="off"/>'
    path = tmp_path / "Calib.qca.txt"
    path.write_text(f"<calibration><cameras>{''.join(cameras)}{inactive}</cameras></calibration>")
    rig = read_rig(path)
    assert rig.unit == "mm" and rig.cameras["cam1"].camera.size == SIZE
    assert_sees(rig, 0.001)
    path.write_text(path.read_text().replace('viewrotation="0"', 'viewrotation="90"', 1))
    with pytest.raises(InputError, match="viewrotation 90, which is not read"):
        read_rig(path)


def opencv_matrix(key: str, value: np.ndarray) -> str:
    values = np.atleast_2d(value)
    data = ", ".join(str(v) for v in values.ravel())
    head = f"{key}: !!opencv-matrix\n   rows: {values.shape[0]}\n   cols: {values.shape[1]}\n"
    return f"{head}   dt: d\n   data: [ {data} ]\n"


def test_easymocap_and_opencv_yaml(tmp_path: Path) -> None:
    head = "%YAML:1.0\n---\n"
    names = 'names:\n  - "cam1"\n  - "cam2"\n'
    intri, extri = head + names, head + names
    for name, rotation in ROTATIONS.items():
        moved = (-rotation @ CENTRES[name]).reshape(3, 1)
        intri += opencv_matrix(f"K_{name}", K) + opencv_matrix(f"dist_{name}", np.array([[*LENS, 0.0]]))
        extri += opencv_matrix(f"R_{name}", cv2.Rodrigues(rotation)[0]) + opencv_matrix(f"Rot_{name}", rotation)
        extri += opencv_matrix(f"T_{name}", moved)
        single = head + "image_width: 640\nimage_height: 480\n" + opencv_matrix("camera_matrix", K)
        single += opencv_matrix("distortion_coefficients", np.array([LENS])) + opencv_matrix("R", rotation)
        (tmp_path / f"{name}.yml").write_text(single + opencv_matrix("T", moved))
    assert_sees(read_rig(tmp_path))
    folder = tmp_path / "easymocap"
    folder.mkdir()
    (folder / "intri.yml").write_text(intri)
    with pytest.raises(InputError, match=r"has no extri\.yml"):
        read_rig(folder)
    (folder / "extri.yml").write_text(extri)
    rig = read_rig(folder / "intri.yml")
    assert_sees(rig)
    assert not rig.cameras["cam1"].has_size


def test_colmap_counts_pixels_from_their_corner(tmp_path: Path) -> None:
    k1, k2, p1, p2 = LENS
    (tmp_path / "cameras.txt").write_text(f"# cameras\n7 OPENCV 640 480 800 810 320.75 240.25 {k1} {k2} {p1} {p2}\n")
    lines = ["# images"]
    quaternions = {"cam1": (0.5, 0.5, 0.5, -0.5), "cam2": (0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5))}
    for number, (name, (w, x, y, z)) in enumerate(quaternions.items()):
        moved = -ROTATIONS[name] @ CENTRES[name]
        lines += [f"{number} {w} {x} {y} {z} {moved[0]} {moved[1]} {moved[2]} 7 {name}/0001.png", "1 2 -1 3 4 5"]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    rig = read_rig(tmp_path)
    assert rig.unit == "unknown"
    assert_sees(rig)


def test_ros_camera_info_with_transforms(tmp_path: Path) -> None:
    for name in ROTATIONS:
        (tmp_path / f"{name}.yaml").write_text(
            f"image_width: 640\nimage_height: 480\ncamera_name: {name}\ndistortion_model: plumb_bob\n"
            f"camera_matrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}\n"
            f"distortion_coefficients: {{rows: 1, cols: 5, data: {[*LENS, 0.0]}}}\n"
        )
    with pytest.raises(InputError, match="no file of transforms beside the camera_info"):
        read_rig(tmp_path)
    # Camera to world, as TF has it: the inverse of the quaternions above; cam2 hangs on a mast at (0, 3, 0).
    (tmp_path / "tf.yaml").write_text(
        "transforms:\n"
        "- {header: {frame_id: world}, child_frame_id: cam1_optical_frame, transform: {translation: {x: 4, y: 0, z: 1},"
        " rotation: {x: -0.5, y: -0.5, z: 0.5, w: 0.5}}}\n"
        "- {header: {frame_id: world}, child_frame_id: mast, transform: {translation: {x: 0, y: 3, z: 0},"
        " rotation: {x: 0, y: 0, z: 0, w: 1}}}\n"
        "- {header: {frame_id: mast}, child_frame_id: cam2_optical_frame, transform: {translation: {x: 0, y: 0, z: 1},"
        " rotation: {x: 0, y: 0.7071067811865476, z: -0.7071067811865476, w: 0}}}\n"
    )
    assert_sees(read_rig(tmp_path))


def example(lens: tuple[float, ...] = LENS) -> CameraRig:
    turns = {name: rotation @ cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0] for name, rotation in ROTATIONS.items()}
    return CameraRig(
        {
            name: make_rig_camera(name, K, lens, SIZE, turns[name], -turns[name] @ CENTRES[name], 0.025)
            for name in turns
        },
        "m",
    )


@pytest.mark.parametrize("lens", [LENS, (*LENS, 0.005)], ids=["k2", "k3"])
@pytest.mark.parametrize("form", FORMS)
def test_what_is_written_is_read(form: str, lens: tuple[float, ...], tmp_path: Path) -> None:
    rig, path = example(lens), tmp_path / {"pose2sim": "a.toml", "qualisys": "a.qca.txt"}.get(form, form)
    write_rig(rig, path, form)
    found = read_rig(path)
    found = found.rescale(0.001) if form == "qualisys" else found
    for name, each in rig.cameras.items():
        ours = found.cameras[name].camera
        assert ours.size == SIZE
        np.testing.assert_allclose(ours.project(POINTS)[0], each.camera.project(POINTS)[0], atol=1e-6)
        assert found.cameras[name].time_offset == (0.025 if form == "pose2sim" else 0)


def test_unusable_calibrations_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_rig(tmp_path / "none.toml")
    (tmp_path / "notes.md").write_text("hello")
    with pytest.raises(InputError, match="no calibration that is read: pose2sim"):
        read_rig(tmp_path / "notes.md")
    with pytest.raises(InputError, match="no calibration that is read: pose2sim"):
        read_rig(tmp_path)
    (tmp_path / "a.toml").write_text("[cam1\n")
    with pytest.raises(InputError, match="cannot be read as TOML"):
        read_rig(tmp_path / "a.toml")
    with pytest.raises(InputError, match="mirrored"):
        make_rig_camera("cam1", K, LENS, SIZE, -ROTATIONS["cam1"], np.zeros(3))
    with pytest.raises(InputError, match="not a rotation matrix"):
        make_rig_camera("cam1", K, LENS, SIZE, 2 * ROTATIONS["cam1"], np.zeros(3))
    alone = CameraRig({"cam1": example().cameras["cam1"]})
    write_rig(alone, tmp_path / "one.toml")
    with pytest.raises(InputError, match="has 1 calibrated cameras, and two or more are needed"):
        read_rig(tmp_path / "one.toml")
    same = {name: RigCamera(example().cameras["cam1"].camera) for name in ("a", "b")}
    write_rig(CameraRig(same), tmp_path / "same.toml")
    with pytest.raises(InputError, match="puts all cameras at one place"):
        read_rig(tmp_path / "same.toml")
    (tmp_path / "fish.toml").write_text(
        (tmp_path / "one.toml").read_text().replace("fisheye = false", "fisheye = true")
    )
    with pytest.raises(InputError, match="fisheye camera"):
        read_rig(tmp_path / "fish.toml")


def test_videos_that_were_scaled_or_cropped() -> None:
    each, notes = example().cameras["cam1"], list[str]()
    pixels = each.camera.project(POINTS)[0]

    def fit(size: tuple[int, int], crop: tuple[float, float] | None = None) -> Camera:
        return fit_to_video("cam1", each, size, crop, notes.append)

    assert fit(SIZE) is each.camera and notes == []
    # Pixels count from the middle of the first one.
    np.testing.assert_allclose(fit((320, 240)).project(POINTS)[0], (pixels + 0.5) / 2 - 0.5, atol=1e-9)
    np.testing.assert_allclose(fit((632, 480)).project(POINTS)[0], pixels - [4, 0], atol=1e-9)
    assert "taken as scaled" in notes[0] and "--crop cam1=LEFT,TOP" in notes[1]
    np.testing.assert_allclose(fit((632, 480), (8, 0)).project(POINTS)[0], pixels - [8, 0], atol=1e-9)
    with pytest.raises(InputError, match=r"is the video turned\?"):
        fit((480, 640))
