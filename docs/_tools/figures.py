# SPDX-License-Identifier: Apache-2.0
"""Draw the figures of the pages into docs/drawn: all of them, or those that are named."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import figures_2d
import figures_3d
import numpy as np

from flowing_puppet_ros.draw.pictures import save

FOLDER = Path(__file__).resolve().parent.parent / "drawn"
WIDEST = 1400  # px


def narrowed(picture: np.ndarray) -> np.ndarray:
    """Return a picture no wider than a page shows it."""
    factor = WIDEST / picture.shape[1]
    if factor >= 1:
        return picture
    return np.asarray(cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def main(names: list[str]) -> int:
    """Draw the named figures, or all, and print how long each took."""
    known = {**figures_2d.FIGURES, **figures_3d.FIGURES}
    unknown = set(names) - set(known)
    if unknown:
        print(f"there is no figure {min(unknown)}; choose from {', '.join(known)}", file=sys.stderr)
        return 2
    FOLDER.mkdir(exist_ok=True)
    bodies = figures_3d.Bodies()
    for name in names or known:
        started = time.perf_counter()
        picture = figures_3d.FIGURES[name](bodies) if name in figures_3d.FIGURES else figures_2d.FIGURES[name]()
        if isinstance(picture, str):
            (FOLDER / f"{name}.svg").write_text(picture)
        else:
            save(narrowed(picture), FOLDER / f"{name}.png")
        print(f"{name}: {time.perf_counter() - started:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
