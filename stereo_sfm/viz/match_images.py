"""Match display: the last keyframe beside the current frame, matched points joined (C++ course system, figure 1).

A sink: it sees images, frames and keyframes of any tracker, and matches are points that both carry under one id.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.pixels import write_image
from stereo_sfm.types import F64, I64, U8, Bool, Frame, Keyframe, StereoImage

_UNMATCHED = (160, 160, 160)  # BGR
_MAX_LINES = 150  # more than this cover the canvas: every k-th is drawn


def draw_matches(left: U8, right: U8, uv_left: F64, uv_right: F64, others: F64, text: str) -> U8:
    """Two images side by side with lines between matches.

    Args:
        left, right: (H, W). uv_left, uv_right: (N, 2) px of the matches, one row each.
        others: (M, 2) px, points of the right image without a match. text: one line for the top.

    Returns:
        (H, 2 W, 3) BGR.
    """
    width = left.shape[1]
    canvas = np.ascontiguousarray(cv2.cvtColor(np.concatenate([left, right], axis=1), cv2.COLOR_GRAY2BGR))
    for u, v in np.rint(others).astype(int).tolist():
        cv2.circle(canvas, (u + width, v), 2, _UNMATCHED, 1, cv2.LINE_AA)
    step = max(1, -(-len(uv_left) // _MAX_LINES))
    a, b = np.rint(uv_left[::step]).astype(int), np.rint(uv_right[::step]).astype(int)
    # Colour by height in the canvas, so that neighbouring lines can be distinguished.
    shade = np.clip(255 * a[:, 1:2] / max(left.shape[0], 1), 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(shade, cv2.COLORMAP_TURBO).reshape(-1, 3)
    for (u0, v0), (u1, v1), colour in zip(a.tolist(), b.tolist(), colours.tolist(), strict=True):
        cv2.line(canvas, (u0, v0), (u1 + width, v1), colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, (u0, v0), 3, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, (u1 + width, v1), 3, colour, 1, cv2.LINE_AA)
    cv2.putText(canvas, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(canvas, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)


def common_rows(first: I64, second: I64) -> tuple[I64, I64]:
    """Rows of both arrays that hold the same ids; ids are unique in each."""
    _, rows_first, rows_second = np.intersect1d(first, second, assume_unique=True, return_indices=True)
    return rows_first.astype(np.int64), rows_second.astype(np.int64)


class MatchImages:
    """Writes `NNNNNN.png` for every k-th frame."""

    def __init__(self, every: int = 1, folder: Path | None = None) -> None:
        """Args:
        every: frames between images. folder: created when the first image is written; may be set later.
        """
        self.folder = folder
        self._every = max(every, 1)
        self._images: dict[int, U8] = {}  # the current frame's, and the last keyframe's
        self._keyframe: Keyframe | None = None

    def put(self, message: object) -> None:
        """Take one message of the run."""
        if isinstance(message, StereoImage):
            kept = self._keyframe.frame_id if self._keyframe is not None else -1
            self._images = {k: image for k, image in self._images.items() if k == kept or k >= message.frame_id - 70}
            self._images[message.frame_id] = message.left
        elif isinstance(message, Frame):
            if message.frame_id % self._every == 0:
                self._draw(message)
        elif isinstance(message, Keyframe):
            self._keyframe = message

    def _draw(self, frame: Frame) -> None:
        keyframe = self._keyframe
        if keyframe is None or not {keyframe.frame_id, frame.frame_id} <= self._images.keys():
            return
        seen = frame.observations
        a, b = common_rows(keyframe.point_ids, seen.point_ids)
        others: Bool = np.ones(len(seen), bool)
        others[b] = False
        state = frame.state.name + (f" ({frame.reason})" if frame.reason else "")
        text = (
            f"keyframe {keyframe.kf_id} (frame {keyframe.frame_id}) | frame {frame.frame_id}: {len(a)} points, {state}"
        )
        canvas = draw_matches(
            self._images[keyframe.frame_id],
            self._images[frame.frame_id],
            keyframe.uv_left[a],
            seen.uv_left[b],
            seen.uv_left[others],
            text,
        )
        folder = self.folder or Path("matches")
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder / f"{frame.frame_id:06d}.png", canvas)
