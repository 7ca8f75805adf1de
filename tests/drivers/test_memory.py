"""Images held in memory as a source."""

from __future__ import annotations

import numpy as np

from stereo_sfm.drivers.memory import PERIOD_NS, MemorySource
from tests.log.recordings import fisheye_rig, stereo_images


def test_images_come_as_they_are() -> None:
    images = stereo_images(4, np.random.default_rng(0))
    with MemorySource(fisheye_rig(), images) as source:
        assert list(source) == images
        assert source.frame_count == 4


def test_a_longer_sequence_is_renumbered_and_reversed_at_the_ends() -> None:
    images = stereo_images(3, np.random.default_rng(0))
    source = MemorySource(fisheye_rig(), images, count=8, there_and_back=True)
    sequence = list(source)
    assert [np.flatnonzero([x.left is y.left for y in images]).item() for x in sequence] == [0, 1, 2, 1, 0, 1, 2, 1]
    assert [x.frame_id for x in sequence] == list(range(8))
    assert set(np.diff([x.stamp_ns for x in sequence])) == {PERIOD_NS}
    assert not any(x.dropped_before for x in sequence)
    again = list(MemorySource(fisheye_rig(), images, count=4))
    assert again[3].left is images[0].left and source.frame_count == 8
