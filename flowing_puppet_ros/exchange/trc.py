# SPDX-License-Identifier: Apache-2.0
"""Write a person as TRC (Track Row Column): marker positions, as OpenSim and Pose2Sim read them."""

from __future__ import annotations

from pathlib import Path

from flowing_puppet_ros.exchange.motion import BodyMotion
from flowing_puppet_ros.units import NANOSECONDS

MM = 1000.0


def write_trc(path: Path, motion: BodyMotion) -> None:
    """Write the joints as markers, millimetres, y up, at the median rate of the frames."""
    motion = motion.resample()
    names, count = motion.model.joint_names, len(motion.stamps_ns)
    rate = f"{NANOSECONDS / motion.step_ns:.6g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{len(names)}\tmm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ"),
        "",
    ]
    seconds = (motion.stamps_ns - motion.stamps_ns[0]) / NANOSECONDS
    for number, (time, joints) in enumerate(zip(seconds, MM * motion.joints, strict=True), start=1):
        lines.append(f"{number}\t{time:.6f}\t" + "\t".join(f"{value:.3f}" for value in joints.reshape(-1)))
    path.write_text("\n".join(lines) + "\n", "utf8")
