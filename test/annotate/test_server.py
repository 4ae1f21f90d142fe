# SPDX-License-Identifier: Apache-2.0
"""The annotation server by its requests: who is answered, and with what."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from flask.testing import FlaskClient

from flowing_puppet_ros.annotate.folder import ImageFolder
from flowing_puppet_ros.annotate.server import MAX_REQUEST_BYTES, make_app
from flowing_puppet_ros.annotate.store import AnnotationStore
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

HOST = "localhost:8008"


def texture(shift: int) -> np.ndarray:
    """Smooth noise (120, 160) moved right by `shift` pixels."""
    noise = np.random.default_rng(0).integers(0, 255, (120, 200), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)[:, 40 - shift : 200 - shift]


@pytest.fixture
def client(tmp_path: Path) -> Iterator[FlaskClient]:
    """Return a client of an application over two images, the second one moved by 3 pixels."""
    for k in range(2):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), cv2.equalizeHist(texture(3 * k)))
    (tmp_path / "broken.png").write_bytes(b"no")
    folder = ImageFolder(tmp_path)
    store = AnnotationStore(folder.root, JOINT_NAMES[10])
    app = make_app(folder, store, 10, (HOST,))
    app.config["SERVER_NAME"] = HOST
    yield app.test_client()
    store.close()


def new_person(client: FlaskClient, view: str = "front") -> dict[str, Any]:
    answer = client.post("/api/new", json={"key": "0.png", "gender": "female", "view": view})
    assert answer.status_code == 200
    return dict(answer.get_json())


def test_the_folder_is_described(client: FlaskClient) -> None:
    told = client.get("/api/folder").get_json()
    assert told["items"] == ["0.png", "1.png", "broken.png"]
    assert told["joint_names"] == list(JOINT_NAMES[10])
    assert len(told["bones"]) == 10


@pytest.mark.parametrize("view", ["front", "back"])
def test_a_new_person_stands_in_the_image_with_sides_as_seen(client: FlaskClient, view: str) -> None:
    person = new_person(client, view)
    at = dict(zip(JOINT_NAMES[10], person["joints"], strict=True))
    assert (at["left_shoulder"][0] > at["right_shoulder"][0]) == (view == "front")
    for name in ("face", "left_wrist", "right_wrist", "left_hip"):
        assert 0 <= at[name][0] <= 160 and 0 <= at[name][1] <= 120


def test_the_outline_is_the_models(client: FlaskClient) -> None:
    person = new_person(client)
    parts = client.post("/api/outline", json={"person": person}).get_json()["parts"]
    model = DeformableStructures.load("female")
    joints = np.array(person["joints"])[:, :2]
    shape = model.puppet_from_joints(joints, model.estimate_scale(joints, np.ones(15)))
    assert {part["part"] for part in parts} == set(model.tree.names)
    for part in parts:
        np.testing.assert_allclose(part["contour"], shape.contours[model.tree.names.index(part["part"])], atol=0.06)
    assert parts[-1]["part"].endswith("lower_arm"), "arms are painted over the torso of a person seen from the front"


def test_people_are_saved_and_read(client: FlaskClient) -> None:
    person = new_person(client)
    saved = client.put("/api/annotation", json={"key": "1.png", "revision": 0, "people": [person]})
    assert saved.get_json() == {"revision": 1}
    read = client.get("/api/annotation?key=1.png").get_json()
    assert read["revision"] == 1 and read["size"] == [160, 120]
    np.testing.assert_allclose(read["people"][0]["joints"], person["joints"], atol=0.005)
    stale = client.put("/api/annotation", json={"key": "1.png", "revision": 0, "people": []})
    assert stale.status_code == 409
    assert client.get("/api/revision?key=1.png").get_json() == {"revision": 1}
    exported = client.get("/api/export/json").get_json(force=True)
    assert list(exported["images"]) == ["1.png"]
    assert len(client.get("/api/export/sticks").data.split()) == 25


def test_people_are_carried_by_the_flow(client: FlaskClient) -> None:
    person = new_person(client)
    client.put("/api/annotation", json={"key": "0.png", "revision": 0, "people": [person]})
    carried = client.post("/api/carry", json={"key": "1.png"}).get_json()["people"]
    inside = [JOINT_NAMES[10].index(name) for name in ("neck", "belly", "left_elbow", "right_elbow")]
    moved = (np.array(carried[0]["joints"]) - np.array(person["joints"]))[inside, :2]
    np.testing.assert_allclose(moved, [[3, 0]] * 4, atol=0.7)
    assert carried[0]["gender"] == "female"


class Finder:
    """Finds the mean puppet at 60 px/m, its face unseen, in bright images."""

    def find(self, image: np.ndarray, *_: Any) -> list[FoundPerson]:
        model = DeformableStructures.load()
        places = model.mean_joints() * 60.0 + [80.0, 60.0]
        confidence = np.where(np.array(model.joint_names) == "face", 0.0, 0.9)
        return [FoundPerson(Keypoints(model.joint_names, places, confidence), 0.9)] if image.mean() > 20 else []


def test_people_are_found_as_a_first_guess(tmp_path: Path) -> None:
    for name, level in (("bright.png", 200), ("dark.png", 0)):
        cv2.imwrite(str(tmp_path / name), np.full((120, 160, 3), level, np.uint8))
    folder = ImageFolder(tmp_path)
    app = make_app(folder, AnnotationStore(folder.root, JOINT_NAMES[10]), 10, (HOST,), Finder())
    app.config["SERVER_NAME"] = HOST
    client = app.test_client()
    (person,) = client.post("/api/find", json={"key": "bright.png"}).get_json()["people"]
    model = DeformableStructures.load()
    seen = np.array(model.joint_names) != "face"
    found = np.array(person["joints"])
    np.testing.assert_allclose(found[seen, :2], (model.mean_joints() * 60.0 + [80.0, 60.0])[seen], atol=1e-6)
    assert found[:, 2].tolist() == seen.astype(int).tolist() and person["view"] == "front"
    nobody = client.post("/api/find", json={"key": "dark.png"})
    assert nobody.status_code == 400 and "add a puppet by hand" in nobody.get_json()["error"]


@pytest.mark.parametrize(("key", "reason"), [("0.png", "none to copy from"), ("1.png", "no one is annotated")])
def test_there_is_nobody_to_carry(client: FlaskClient, key: str, reason: str) -> None:
    answer = client.post("/api/carry", json={"key": key})
    assert answer.status_code == 400
    assert reason in answer.get_json()["error"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Host": "evil.example:8008"},
        {"Host": "localhost:1"},
    ],
)
@pytest.mark.parametrize("path", ["/", "/api/image?key=0.png", "/api/folder", "/page/main.js"])
def test_strangers_are_refused(client: FlaskClient, headers: dict[str, str], path: str) -> None:
    answer = client.get(path, headers=headers)
    assert answer.status_code == 403
    assert b"items" not in answer.data


def test_the_own_page_is_answered_and_kept_to_itself(client: FlaskClient) -> None:
    answer = client.get("/", headers={"Origin": f"http://{HOST}", "Sec-Fetch-Site": "same-origin"})
    assert answer.status_code == 200
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy
    assert b"http://" not in answer.data.replace(b"http://www.w3.org", b"") and b"https://" not in answer.data


BAD_REQUESTS = [
    ("get", "/api/image?key=../0.png", None),
    ("get", "/api/image?key=broken.png", None),
    ("get", "/api/image", None),
    ("get", "/api/annotation?key=%00", None),
    ("put", "/api/annotation", {"key": "0.png", "revision": "0", "people": []}),
    ("put", "/api/annotation", {"key": ["0.png"], "revision": 0, "people": []}),
    ("put", "/api/annotation", {"key": "annotations.json", "revision": 0, "people": []}),
    ("put", "/api/annotation", [1]),
    ("post", "/api/outline", {}),
    ("post", "/api/new", {"key": "0.png", "gender": "../neutral", "view": "front"}),
]


@pytest.mark.parametrize(("method", "path", "body"), BAD_REQUESTS)
def test_bad_requests_are_one_sentence(client: FlaskClient, method: str, path: str, body: object) -> None:
    answer = getattr(client, method)(path, json=body) if body is not None else client.get(path)
    assert answer.status_code == 400
    assert "\n" not in answer.get_json()["error"]


def test_joints_in_one_place_are_one_sentence(client: FlaskClient) -> None:
    person = new_person(client) | {"joints": [[5, 5, 1]] * 15}
    answer = client.post("/api/outline", json={"person": person})
    assert answer.status_code == 400 and "scale" in answer.get_json()["error"]


def test_huge_and_broken_bodies_are_refused(client: FlaskClient) -> None:
    huge = client.put("/api/annotation", data=b"[" * (MAX_REQUEST_BYTES + 1), content_type="application/json")
    assert huge.status_code == 413
    broken = client.put("/api/annotation", data=b"{", content_type="application/json")
    assert broken.status_code == 400
    plain = client.put("/api/annotation", data=b"{}", content_type="text/plain")
    assert plain.status_code == 415


@pytest.mark.parametrize("path", ["/page/../server.py", "/page/..%2fserver.py", "/server.py", "/page/"])
def test_only_the_page_is_served(client: FlaskClient, path: str) -> None:
    assert client.get(path).status_code == 404


def test_without_its_extra_the_verb_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "waitress", None)
    assert main(["annotate", str(tmp_path)]) == 2
    assert "pip install 'flowing_puppet_ros[annotate]'" in capsys.readouterr().err
