# SPDX-License-Identifier: Apache-2.0
"""Track the people of video clips with MediaPipe's pose; `flowing-puppet bench peers` runs this.

Runs in its own environment (mediapipe 0.10.21). Arguments: clips. Prints one JSON object: for each clip the joints of
every frame in the form of keypoints.json, and the processor milliseconds per frame without the first of every clip,
which loads the model.
"""

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import mediapipe
import numpy as np

NAMES = {
    "nose": 0,
    "left_shoulder": 11,
    "right_shoulder": 12,
    "left_elbow": 13,
    "right_elbow": 14,
    "left_wrist": 15,
    "right_wrist": 16,
    "left_hip": 23,
    "right_hip": 24,
}


def read_frames(clip: str) -> Iterator[np.ndarray]:
    """Yield the RGB images of a video."""
    video = cv2.VideoCapture(clip)
    while True:
        good, image = video.read()
        if not good:
            return
        yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def main(clips: list[str]) -> None:
    """Track and print."""
    result: dict[str, object] = {}
    seconds, count = 0.0, 0
    for clip in clips:
        pose = mediapipe.solutions.pose.Pose(model_complexity=1)
        people = {}
        for index, image in enumerate(read_frames(clip)):
            started = time.process_time()
            found = pose.process(image).pose_landmarks
            if index:
                seconds, count = seconds + time.process_time() - started, count + 1
            height, width = image.shape[:2]
            if found is not None:
                marks = [found.landmark[number] for number in NAMES.values()]
                people[str(index)] = [[[m.x * width - 0.5, m.y * height - 0.5, m.visibility] for m in marks]]
        pose.close()
        result[Path(clip).stem] = {"joint_names": list(NAMES), "frames": people}
    print(json.dumps({"clips": result, "milliseconds_a_frame": 1000 * seconds / max(count, 1)}))


if __name__ == "__main__":
    main(sys.argv[1:])
