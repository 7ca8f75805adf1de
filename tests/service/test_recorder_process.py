"""The body of the recorder's process: sessions that begin where nothing can be written."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from queue import SimpleQueue

import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.log import topics
from stereo_sfm.log.provenance import Opening
from stereo_sfm.pipeline.images import ImageLayout, ImageRing
from stereo_sfm.recording import segment_recorder
from stereo_sfm.recording.segments import recordings, segments
from stereo_sfm.service import recorder_process
from stereo_sfm.service.recorder_process import Begin, Finish
from tests.pipeline.test_pipeline import SlidingWall
from tests.recording.test_segments import frame, messages, policy, start


@pytest.mark.parametrize("refused", [20, 30], ids=["some", "all but the end"])
def test_a_session_that_begins_on_a_full_disk_loses_no_pose(
    refused: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = [True]
    made = segment_recorder.new_recording

    def new_recording(*args: object) -> Path:
        if full[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return made(*args)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(segment_recorder, "new_recording", new_recording)
    monkeypatch.setattr(recorder_process, "AGAIN_S", 0.0)
    source = SlidingWall(30)
    ring = ImageRing(ImageLayout.of(source.rig), 2)
    sent = SimpleQueue[object]()
    body = recorder_process._Body(sent.put)  # pyright: ignore[reportPrivateUsage]
    about = Config(), "wall", Opening()
    body.take(Begin(policy(tmp_path), source.rig, *about, (ring.layout, ring.slots, ring.name)))
    for k, image in enumerate(source):
        full[0] = k < refused
        body.take((k, ring.write(k % 2, image, 0.0)))
        body.take(frame(image))
    full[0] = False
    body.take(Finish())
    ring.close()
    assert sent.qsize() == 30  # each slot is free again
    (folder,) = recordings(tmp_path)
    poses = [r.sequence for s in segments(folder) for r in messages(s.poses, topics.FRAME)]
    drops = [r.sequence for s in segments(folder) for r in messages(s.poses, topics.DROPPED)]
    assert sorted(poses) == list(range(30)) and drops == list(range(refused))
    if refused < 30:
        with open_source(folder) as recorded:
            assert [i.frame_id for i in recorded] == list(range(refused, 30))


def test_a_folder_where_another_service_records_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_process, "AGAIN_S", 0.0)
    other, source = start(tmp_path), SlidingWall(2)
    ring = ImageRing(ImageLayout.of(source.rig), 2)
    body = recorder_process._Body(SimpleQueue[object]().put)  # pyright: ignore[reportPrivateUsage]
    about = Config(), "wall", Opening()
    body.take(Begin(policy(tmp_path), source.rig, *about, (ring.layout, ring.slots, ring.name)))
    first, second = source
    body.take((0, ring.write(0, first, 0.0)))
    assert recordings(tmp_path) == [other.folder]
    assert "another service records there" in body._problem  # pyright: ignore[reportPrivateUsage]
    other.close(20.0)
    body.take((1, ring.write(1, second, 0.0)))
    assert not body._problem  # pyright: ignore[reportPrivateUsage]
    body.take(Finish())
    ring.close()
    assert len(recordings(tmp_path)) == 2
