"""The reference: every stage in this process, one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from drivers.source import Source
from stereo_sfm.config import Config
from stereo_sfm.pipeline.sinks import Sink, StageTimes
from stereo_sfm.timing import Spans
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import Frame


def run_inline(source: Source, config: Config, sinks: Sequence[Sink] = ()) -> Iterator[Frame]:
    """Track every image of an open source and yield its frame; every message also goes to the sinks, in order."""
    spans = Spans()
    tracker = make_tracker(config, source.rig, spans, source.ground_truth)

    def publish(message: object) -> None:
        for sink in sinks:
            sink.put(message)

    for image in source:
        publish(image)
        with spans.span("track"):
            frame, keyframe = tracker.step(image)
        publish(frame)
        if keyframe is not None:
            publish(keyframe)
        publish(StageTimes(frame.frame_id, spans.take()))
        yield frame
