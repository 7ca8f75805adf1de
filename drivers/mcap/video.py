"""Topics of video (H.264, H.265, AV1, VP9), decoded by FFmpeg through PyAV, which the extra `video` installs."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any

import numpy as np

from stereo_sfm.drivers.mcap.messages import ImageMessage
from stereo_sfm.errors import require
from stereo_sfm.pixels import MAX_PIXELS

KEYFRAMES_NS = 10_000_000_000  # encoders send an image that needs no earlier one at least so often


class VideoDecoder:
    """The images of topics whose messages must be decoded one after the other, from a keyframe on."""

    def __init__(self) -> None:
        self._codecs: dict[str, Any] = {}  # by topic

    def decoded(self, topic: str, message: ImageMessage, stamp_ns: int) -> tuple[int, ImageMessage] | None:
        """The next image and its stamp in ns; None where the video has none yet.

        The image is the message's own unless the encoder changed the order (B-frames): then it is an earlier one.

        Raises:
            ValueError: a damaged message, or one before the first keyframe.
            StereoSfmError: PyAV is not installed.
        """
        av = _library()
        codec = self._codecs.get(topic)
        if codec is None:
            codec = self._codecs[topic] = av.CodecContext.create(message.video, "r")
            codec.thread_count = 1  # threads would hold back some images
            codec.options = {"max_pixels": str(MAX_PIXELS)}
        packet = av.Packet(message.data)
        packet.pts = stamp_ns
        frame = next(iter(codec.decode(packet)), None)
        if frame is None:
            return None
        if frame.format.is_rgb or frame.format.components[0].bits != 8:
            frame = frame.reformat(format="gray")
        plane = frame.planes[0]  # the brightness
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
        image = replace(
            message, compressed=False, data=rows.tobytes(), width=frame.width, height=frame.height, step=frame.width,
            encoding="mono8",
        )  # fmt: skip
        return stamp_ns if frame.pts is None else int(frame.pts), image


def _library() -> Any:
    require(("av",), "video", "reading topics of video")
    return importlib.import_module("av")
