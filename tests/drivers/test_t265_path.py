"""The whole path: USB bytes of a simulated T265 to the error of the trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.t265.simulated.content import Content, room_content, source_content
from stereo_sfm.drivers.t265.simulated.faults import Faults
from stereo_sfm.geometry import se3
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import TrackState
from tests.drivers.t265_rig import open_camera, take


def path_error(content: Content, faults: Faults, count: int) -> tuple[float, float, int, list[TrackState]]:
    """RMSE of the positions (m), length of the path (m), frames lost by fault, states of the tracker."""
    with open_camera(faults, content, booted=True) as source:
        images = take(source, count)
        truth = source.truth(np.array([i.stamp_ns for i in images]))
        lost = int(source.counters["dropped"]) - source.camera.overruns
        rig = source.rig
    frames = list(run(MemorySource(rig, images)))
    estimate = np.array([f.odom_T_cam[:3, 3] for f in frames])
    true = (se3.inverse(truth.poses[0]) @ truth.poses)[:, :3, 3]
    rmse = float(np.sqrt(((estimate - true) ** 2).sum(1).mean()))
    return rmse, truth.length, lost, [f.state for f in frames]


@pytest.fixture(scope="module")
def room() -> Content:
    return room_content(18)


def test_usb_bytes_to_trajectory(room: Content) -> None:
    error, length, lost, states = path_error(room, Faults(), 18)
    assert length > 0.25
    assert (lost, set(states)) == (0, {TrackState.OK})
    assert error < 0.004


def test_trajectory_continues_over_injected_faults(room: Content) -> None:
    faults = Faults(
        drop_left=frozenset({2}),
        drop_right=frozenset({4}),
        half={6: 196_608},
        split={9: 240_128},
        right_skew_ns={11: 2_000_000},
        swapped=frozenset({12}),
        garbage=frozenset({13}),
        empty=frozenset({15}),
    )
    error, length, lost, states = path_error(room, faults, 18 - 6)
    assert lost == 6
    assert length > 0.25
    assert set(states) == {TrackState.OK}
    assert error < 0.004


@pytest.mark.slow
def test_simulated_store_through_usb() -> None:
    """45 frames of the store, without and with faults."""
    content = source_content("sim:loop?frames=45", 45)
    error, length, lost, states = path_error(content, Faults(), 45)
    assert (lost, set(states)) == (0, {TrackState.OK})
    assert error < 0.02 * length + 0.003
    faults = Faults(drop_left=frozenset({10}), half={20: 100_000}, counter_skips=frozenset({25}))
    error, length, lost, states = path_error(content, faults, 43)
    assert lost == 2
    assert set(states) == {TrackState.OK}
    assert error < 0.02 * length + 0.003


def test_images_of_a_real_t265_come_through_unchanged(data_root: Path) -> None:
    """Its factory calibration and its images, as the simulated camera's own."""
    content = source_content(f"kapture:{data_root / 't265_office'}", 3)
    with open_camera(content=content, booted=True) as source:
        images = take(source, 3)
    for ours, theirs in ((source.rig.left, content.rig.left), (source.rig.right, content.rig.right)):
        assert ours is not None and theirs is not None
        np.testing.assert_allclose(ours.params[:8], theirs.params[:8], rtol=1e-6)
    assert source.rig.baseline == pytest.approx(content.rig.baseline, abs=1e-7)
    for image in images:
        left, right = content.image(source.frame_shown(image.stamp_ns))
        assert image.right is not None
        assert np.array_equal(image.left, left) and np.array_equal(image.right, right)
