# SPDX-License-Identifier: Apache-2.0
"""Label images of people: whose each label is, and what cannot be used."""

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.pairing.person_masks import add_masks

FACTORY = BagMessageFactory()
SIZE = (640, 480)


def person(x: float, confidence: float = 0.9) -> PuppetJoints:
    """Return somebody with six joints about x px; two more are unknown."""
    pixels = np.array([[x + step, 200.0 + 10 * step] for step in range(6)] + [[np.nan, np.nan]] * 2)
    return PuppetJoints("a1", pixels, np.r_[np.full(6, confidence), 0.0, 0.0], np.zeros(8, dtype=bool))


def labels(shape: tuple[int, int] = (240, 320), encoding: str = "mono8", **bands: int) -> object:
    """Return a label image with a band of columns for every label, x<first column>=label, 40 columns wide."""
    image = np.zeros(shape, dtype=np.uint8)
    for name, label in bands.items():
        image[:, int(name[1:]) : int(name[1:]) + 40] = label
    return make_image(FACTORY, make_header(FACTORY, 1, "eye"), image, encoding)


def test_a_label_is_whose_joints_lie_on_it() -> None:
    # Half the size of the image: the person at 100 px is in columns 50 to 53, the other one in 200 to 203.
    near, far, nobody = add_masks([person(100), person(400), person(600)], labels(x30=7, x180=2), SIZE)
    assert near.mask is not None
    assert far.mask is not None
    assert nobody.mask is None
    inside = np.array([[100.0, 200.0], [400.0, 200.0]])
    assert (near.mask.measure_distance(inside) < 0).tolist() == [True, False]
    assert (far.mask.measure_distance(inside) < 0).tolist() == [False, True]
    assert near.mask.area == pytest.approx(80 * 480)


def test_a_label_that_few_joints_lie_on_is_nobodys() -> None:
    reaching = person(100)
    reaching.pixels[0] = 400, 200
    assert add_masks([reaching], labels(x180=2), SIZE)[0].mask is None
    assert add_masks([person(100, confidence=0.1)], labels(x30=7), SIZE)[0].mask is None


def test_what_is_no_label_image_of_the_camera_is_one_sentence() -> None:
    with pytest.raises(InputError, match="320x320 on person_masks is not of the 640x480 image"):
        add_masks([person(100)], labels((320, 320), x30=1), SIZE)
    with pytest.raises(InputError, match="must be mono8"):
        add_masks([person(100)], make_image(FACTORY, make_header(FACTORY, 1, "eye"), np.zeros((48, 64, 3), np.uint8),
                                            "rgb8"), SIZE)  # fmt: skip
