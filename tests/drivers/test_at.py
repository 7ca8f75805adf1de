"""Frames at chosen positions: the same as those of an iteration, and no others are made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.rectified import rectified
from stereo_sfm.drivers.replayed import ReplayedSource
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import Source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage
from tests.drivers.dataset_folders import make_kitti

SPEC = "sim:aisle?camera=pinhole&size=160x100&frames=9&effects=0"


def in_memory() -> MemorySource:
    with open_source(SPEC) as source:
        return MemorySource(source.rig, list(source), count=14, there_and_back=True)


@pytest.mark.parametrize(
    "opened",
    [
        lambda folder: open_source(SPEC),
        lambda folder: open_source(f"{SPEC}&drop=0.3"),
        lambda folder: open_source(make_kitti(folder, frames=9)),
        lambda folder: in_memory(),
        lambda folder: rectified(open_source(SPEC), "pinhole"),
        lambda folder: ReplayedSource(open_source(SPEC), range(1, 9)),
    ],
)
def test_the_frames_are_those_of_the_iteration(opened: Callable[[Path], Source], tmp_path: Path) -> None:
    with opened(tmp_path) as source:
        images = list(source)
        for positions in ([0, 2, 5], [1], range(3), []):
            chosen = list(source.at(positions))
            assert [i.frame_id for i in chosen] == [images[k].frame_id for k in positions]
            for image, k in zip(chosen, positions, strict=True):
                assert image.stamp_ns == images[k].stamp_ns
                np.testing.assert_array_equal(image.left, images[k].left)


def test_a_replay_ends_with_the_last_frame_of_the_run() -> None:
    """What follows may be what ended the run."""

    class Damaged(MemorySource):
        def __iter__(self) -> Iterator[StereoImage]:
            yield from self.images[:5]
            raise StereoSfmError("damaged")

    with open_source(SPEC) as source:
        damaged = Damaged(source.rig, list(source))
    assert [image.frame_id for image in ReplayedSource(damaged, (1, 2, 4))] == [1, 2, 4]
    with pytest.raises(StereoSfmError, match="damaged"):
        list(ReplayedSource(damaged, (1, 2, 5)))


def test_rectify_renders_no_more_than_it_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[int] = []
    frame = SimSource.frame
    monkeypatch.setattr(SimSource, "frame", lambda self, k, *rest: (rendered.append(k), frame(self, k, *rest))[1])
    assert main(["rectify", SPEC, "--frames", "2", "-o", str(tmp_path / "out")]) == 0
    assert rendered == [0, 4]
    assert len(list((tmp_path / "out").glob("pair_*.png"))) == 2
