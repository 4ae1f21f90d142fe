# SPDX-License-Identifier: Apache-2.0
"""The confidence of bodies against how often they are right."""

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.evaluate.scene.reliability import tabulate_reliability
from flowing_puppet_ros.evaluate.scene.scene_score import GhostScore, PersonScore, count_id_switches

PERSON = PersonScore("a", 0, 5.0, 0.0, 100, 5.0, True, True, "b1", 0.0, 0.0, 0.0, 0.05, False, 0.9)


def test_ghosts_and_distant_joints_are_wrong_and_unknown_joints_do_not_count() -> None:
    people = [PERSON, PERSON, replace(PERSON, joint_error=0.2), replace(PERSON, joint_error=np.nan)]
    people += [replace(PERSON, found=False, confidence=np.nan), replace(PERSON, joint_error=0.3, confidence=0.1)]
    rows = tabulate_reliability(people, [GhostScore("a", 0, 0, 1, 0.81)])
    assert [(row["confidence"], row["bodies"], row["right_share"]) for row in rows] == [
        ("0.0 to 0.2", 1, 0.0),
        ("0.8 to 1.0", 4, 0.5),
    ]
    assert rows[1]["mean_confidence"] == (3 * 0.9 + 0.81) / 4
    assert tabulate_reliability([replace(PERSON, joint_error=np.nan)], []) == []


def test_another_id_in_another_sequence_is_no_switch() -> None:
    scans = [replace(PERSON, scan=scan, identity=own) for scan, own in (("x-0", "b1"), ("x-1", "b2"), ("y-0", "b3"))]
    assert count_id_switches(scans) == 1
