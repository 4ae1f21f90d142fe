# SPDX-License-Identifier: Apache-2.0
"""Fit the people in one depth image or organised cloud for `flowing-puppet fit`, with its colours or without.

With colours the keypoint networks say who is there: only they get a body, each from their own points. Without, people
are found by their geometry, as in other scenes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.up_axis_search import FrameFit, measure_stature
from flowing_puppet_ros.body.scans.names import UNITS
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, parse_axis, rotation_to_z_up
from flowing_puppet_ros.body.scans.unit import ScanUnit
from flowing_puppet_ros.cli.scans.depth_view import (
    DepthView,
    is_depth_image,
    read_colour,
    read_depth_view,
    read_organised,
)
from flowing_puppet_ros.cli.scans.fit_people import FitOptions
from flowing_puppet_ros.cli.scans.fit_scene import fit_one_sided_scene
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, place_joints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks.choice import are_installed, load_networks
from flowing_puppet_ros.image.networks.sources import IMAGE_SIDE_PX
from flowing_puppet_ros.model.sp import StitchedPuppet

MAX_POINTS = 80_000  # of an image, evenly thinned
NO_NETWORKS = "the keypoint networks are not installed, so the colours were not used; flowing-puppet networks --install"


def read_view(source: Path, options: FitOptions) -> DepthView | None:
    """Read a file as a depth image or as an organised cloud with colours; None where it is to be read as a scan.

    Raises:
        InputError: when it cannot be used, or flags do not fit the file.
    """
    if is_depth_image(source, options.camera_info is not None):
        view = read_depth_view(source, options.camera_info, options.unit)
    elif source.suffix.lower() == ".pcd" and (options.scene or options.color is not None) and not options.camera_info:
        metres = UNITS["m" if options.unit == "auto" else options.unit]
        found = read_organised(source, metres) if source.is_file() else None
        if found is None or (found.rgb is None and options.color is None):
            _refuse_colour(source, options)
            return None
        view = found
    else:
        _refuse_colour(source, options)
        return None
    return view if options.color is None else view.paint(read_colour(options.color, view.camera.size))


def fit_view(
    view: DepthView, source: Path, fitter: BodyFitter, options: FitOptions
) -> tuple[list[FrameFit], tuple[str, ...]]:
    """Return the bodies of the people in a view, the one with most points first, and notes for the user.

    Raises:
        PuppetError: when it shows nobody.
    """
    up = parse_axis(view.up if options.up == "auto" else options.up)
    notes: tuple[str, ...] = (view.note,) if view.note else ()
    frame = ScanFrame(1.0, rotation_to_z_up(up))
    if view.rgb is not None and are_installed():
        fits = _fit_puppets(view, frame, source, fitter)
    else:
        notes += (NO_NETWORKS,) if view.rgb is not None else ()
        found = fit_one_sided_scene(fitter, view.points, 1.0, [up], "single", options.segmentation)
        if found is None:
            raise PuppetError(
                f"{source} shows no person among its {len(view.points)} depths; check --unit, --up and --camera-info"
            )
        frame, fits = found.frame, found.fits
        notes += found.notes
    unit = ScanUnit.named("m")
    return [FrameFit(frame, unit, fit, True, True, measure_stature(fitter.model, fit.joints)) for fit in fits], notes


def _fit_puppets(view: DepthView, frame: ScanFrame, source: Path, fitter: BodyFitter) -> list[BodyFit]:
    networks = load_networks("neural", IMAGE_SIDE_PX, thorough=True)
    assert networks is not None
    assert view.rgb is not None
    puppets = [
        puppet
        for number, person in enumerate(networks.find(view.rgb))
        if (puppet := _place(fitter.model, str(number), person.keypoints))
    ]
    if not puppets:
        raise PuppetError(f"the keypoint networks find nobody in the colours of {source}, so nobody is fitted")
    rows = slice(None, None, 1 + len(view.points) // MAX_POINTS)
    camera = view.turn_camera(frame.rotation)
    cloud = SeenCloud.of(frame.to_body(view.points[rows]), camera)
    image = view.image.turn(frame.rotation).thin(np.arange(len(view.points))[rows])
    found = PeopleFitter(fitter, FusionSettings()).fit_people(cloud, puppets, image)
    if not found:
        raise PuppetError(
            f"none of the {len(puppets)} people that the networks find in the colours of {source} has depth; check that"
            " both are of one moment and one camera"
        )
    return [fit for _, fit in found]


def _place(model: StitchedPuppet, identity: str, keypoints: Keypoints) -> PuppetJoints | None:
    return place_joints(model, identity, keypoints.names, keypoints.xy, keypoints.confidence, mask=keypoints.mask)


def _refuse_colour(source: Path, options: FitOptions) -> None:
    """Raise InputError when flags ask for what a file that is no image cannot give."""
    if options.color is not None:
        raise InputError(
            f"{source} has no pixels that --color could belong to; give a depth image or an organised .pcd"
        )
    if options.camera_info is not None:
        raise InputError(f"{source} is not a depth image, so --camera-info says nothing about it; leave it out")
