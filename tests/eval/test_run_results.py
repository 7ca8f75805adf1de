"""What a run's numbers claim: scale only where there is one, a place in the map only where one was found."""

from __future__ import annotations

import dataclasses
import errno
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import from_os_error
from stereo_sfm.eval.evaluate import evaluate, table
from stereo_sfm.eval.record import KeyframeRow, RunRecord
from stereo_sfm.eval.run_results import scale_free, write_results
from stereo_sfm.eval.statistics import failure, summary
from stereo_sfm.geometry import se3
from stereo_sfm.messages import LogEnded
from stereo_sfm.types import (
    F64,
    CalibrationUpdate,
    Dropped,
    Frame,
    Keyframe,
    LoopResult,
    MapUpdate,
    Observations,
    RowErrors,
    TrackState,
    Trajectory,
)
from tests.synthetic import pinhole_rig

COUNT = 30


def camera_path() -> F64:
    steps: F64 = np.arange(float(COUNT))[:, None] * np.array([0.0, 0, 0.1, 0, 0.02, 0])
    return se3.exp(steps)


def record_of(poses: F64, placed_from: int) -> RunRecord:
    """A keyframe every ten frames; those before frame `placed_from` got no place in the map."""
    record = RunRecord()
    none = np.zeros(0, np.int64)
    seen = Observations(none, np.zeros((0, 2)), np.zeros((0, 2)), none.astype(np.int32), np.zeros(0, bool))
    for k, pose in enumerate(poses):
        reference = 10 * (k // 10)
        kf_T_cam = se3.inverse(poses[reference]) @ pose
        record.put(Frame(k, k * 10**8, pose, np.eye(6), TrackState.OK, "", seen, reference, kf_T_cam))
        if k == reference and k >= placed_from:
            record.put(
                MapUpdate(k, k, np.array([k]), pose[None], none, np.zeros((0, 3)), none, none.reshape(-1, 2), np.eye(4))
            )
    return record


def results(tmp_path: Path, record: RunRecord, rig: Rig, config: Config) -> tuple[dict[str, Any], list[str], str]:
    truth = camera_path()
    truth[:, :3, 3] *= 3.0
    stats, evaluations = write_results(
        tmp_path, "test", rig, config, record, 1.0, Trajectory(np.arange(COUNT) * 10**8, truth)
    )
    return stats, summary(stats, evaluations), (tmp_path / "report.md").read_text()


def test_gravity_of_a_saved_map_has_no_sigma_of_this_run(tmp_path: Path) -> None:
    record = record_of(camera_path(), 0)
    record.down = np.array([0.0, 1.0, 0.0])
    assert results(tmp_path, record, pinhole_rig(), Config())[0]["gravity"] is None
    record.down_information = 1e4
    sigma_deg = results(tmp_path, record, pinhole_rig(), Config())[0]["gravity"]["sigma_deg"]
    assert sigma_deg == pytest.approx(np.degrees(0.01))


def test_one_camera_is_evaluated_after_scale_alignment(tmp_path: Path) -> None:
    config = Config(odometry=dataclasses.replace(Config().odometry, method="pnp", monocular=True))
    assert scale_free(config, pinhole_rig())
    one = dataclasses.replace(pinhole_rig(), right=None, left_T_right=np.eye(4))
    assert scale_free(Config(odometry=dataclasses.replace(Config().odometry, method="pnp")), one)
    for method, other in (("flow", {"monocular": True}), ("em-r", {"monocular": True}), ("eight-point", {})):
        assert not scale_free(
            Config(odometry=dataclasses.replace(Config().odometry, method=method, **other)), pinhole_rig()
        )
    assert scale_free(
        Config(odometry=dataclasses.replace(Config().odometry, method="eight-point", scale="unit")), pinhole_rig()
    )
    _, lines, report = results(tmp_path, record_of(camera_path(), 0), pinhole_rig(), config)
    assert any("one camera has no scale" in line for line in lines) and "baseline" not in report
    assert not any("SE3" in line for line in lines)


def test_a_wrong_scale_of_two_cameras_is_reported(tmp_path: Path) -> None:
    assert not scale_free(Config(), pinhole_rig())
    _, lines, report = results(tmp_path, record_of(camera_path(), 0), pinhole_rig(), Config())
    assert any("SE3 aligned" in line for line in lines) and "check the baseline" in report


@pytest.mark.parametrize(("scale", "message"), [(3.0, "is 66.7 % too short"), (0.5, "is 100.0 % too long")])
def test_a_length_is_too_long_or_too_short(tmp_path: Path, scale: float, message: str) -> None:
    """Of a path of some metres; one of centimetres does not determine the scale."""
    for size, told in ((1.0, True), (0.02, False)):
        truth, estimate = camera_path(), camera_path()
        estimate[:, :3, 3] *= size
        truth[:, :3, 3] *= size * scale
        reference = Trajectory(np.arange(COUNT) * 10**8, truth)
        write_results(tmp_path, "x", pinhole_rig(), Config(), record_of(estimate, 0), 1.0, reference)
        assert (message in (tmp_path / "report.md").read_text()) == told


def test_frames_without_a_place_in_the_map_are_left_out(tmp_path: Path) -> None:
    record = record_of(camera_path(), 10)
    mapped = record.mapped()
    assert mapped is not None and len(mapped) == COUNT - 10 and len(record.odometry()) == COUNT
    stats, lines, report = results(tmp_path, record, pinhole_rig(), Config())
    assert stats["unplaced"] == 10 and failure(stats) == ""
    assert any("10 of the tracked frames were not found in the map" in line for line in lines)
    assert "is known for 20 of 30 images" in report
    assert "**WARN**: 10 of the tracked frames were not found in the map" in report


def test_lost_intervals_and_gaps_are_in_the_report(tmp_path: Path) -> None:
    record, seen = RunRecord(), Observations.empty()
    for k, pose in enumerate(camera_path()):
        lost = 10 <= k < 13
        state, reason = (TrackState.LOST, "too_few_points") if lost else (TrackState.OK, "")
        stamp_ns = (k + 5 * (k >= 20)) * 10**8
        record.put(Frame(k, stamp_ns, pose, np.eye(6), state, reason, seen, 0, np.eye(4)))
    stats, _, report = results(tmp_path, record, pinhole_rig(), Config())
    assert "| 1.00 s | 1.30 s | 3 | too few points | too few points could be tracked: check the images" in report
    assert "| 1.90 s | 2.50 s | 5 |" in report and "latency" not in report  # which only live cameras have
    assert [gap["missing"] for gap in stats["stamp_gaps"]] == [5]


def test_localizing_only_says_what_came_of_the_map(tmp_path: Path) -> None:
    for placed_from, said in ((10, "20 of 30 tracked frames, first found after 1.0 s"), (COUNT, "never")):
        record = record_of(camera_path(), placed_from)
        record.localize_only = True
        record.keyframes = {k: KeyframeRow(k, k * 10**8, np.eye(4), 0.0, submap_id=0) for k in (0, 10, 20)}
        _, lines, report = results(tmp_path, record, pinhole_rig(), Config())
        assert f"localized in the saved map: {said}" in lines and f"localized in the saved map: {said}" in report


def test_never_found_in_the_map_is_a_failure(tmp_path: Path) -> None:
    stats, _, _ = results(tmp_path, record_of(camera_path(), COUNT), pinhole_rig(), Config())
    assert "never found" in failure(stats)
    assert not (tmp_path / "trajectory_map.tum").exists() and (tmp_path / "trajectory_odom.tum").exists()


def test_unconnected_submaps_are_reported(tmp_path: Path) -> None:
    record, none = record_of(camera_path(), 0), np.zeros(0, np.int64)
    nothing = np.zeros((0, 2))
    for kf_id, submap in ((0, 0), (10, 1), (20, 1)):
        keyframe = Keyframe(
            kf_id, kf_id, kf_id * 10**8, camera_path()[kf_id], none, nothing, nothing, np.zeros((0, 3)),
            np.zeros((0, 32), np.uint8), submap_id=submap,
        )  # fmt: skip
        record.put(keyframe)
    assert record.unconnected_submaps() == 2
    _, lines, report = results(tmp_path, record, pinhole_rig(), Config())
    assert (
        any("2 submaps that no loop connects" in line for line in lines)
        and "the map is in 2 unconnected submaps" in report
    )
    loop = LoopResult(20, 0, np.eye(4), np.eye(6), none.reshape(-1, 2), 50, 0.1, "", ())
    record.put(loop)
    assert record.unconnected_submaps() == 1
    assert record.closure_drifts() == []  # there was no odometry between the submaps
    assert not any("no loop connects" in line for line in results(tmp_path, record, pinhole_rig(), Config())[1])


def test_a_saved_map_connects_all_submaps() -> None:
    record = RunRecord(localize_only=True)
    record.keyframes = {k: KeyframeRow(k, k, np.eye(4), 0.0, submap_id=k) for k in range(3)}
    assert record.unconnected_submaps() == 1


def test_frames_are_interpolated_between_keyframe_corrections(tmp_path: Path) -> None:
    """The map moved the second keyframe by 9 cm after the frames between were tracked: each gets its share."""
    record, none = record_of(camera_path(), 0), np.zeros(0, np.int64)
    record.keyframes = {k: KeyframeRow(k, k * 10**8, camera_path()[k], 0.0, submap_id=0) for k in (0, 10, 20)}
    aside = np.eye(4)
    aside[0, 3] = 0.09
    record.put(
        MapUpdate(
            40, 20, np.array([10]), (aside @ camera_path()[10])[None], none, np.zeros((0, 3)), none,
            none.reshape(-1, 2), np.eye(4),
        )
    )  # fmt: skip
    mapped = record.mapped()
    assert mapped is not None
    off = mapped.poses[:, 0, 3] - camera_path()[:, 0, 3]
    np.testing.assert_allclose(off[:11], 0.009 * np.arange(11), atol=2e-5)
    np.testing.assert_allclose(off[10:21], 0.009 * np.arange(10, -1, -1), atol=2e-5)
    np.testing.assert_allclose(off[21:], 0.0, atol=1e-12)


def test_frames_of_an_odometry_with_a_wrong_scale_are_right_between_right_keyframes() -> None:
    """It starts from rest, so that half of the time is a fourth of the way."""
    true = np.tile(np.eye(4), (11, 1, 1))
    true[:, 2, 3] = 0.01 * np.arange(11) ** 2
    scaled = true.copy()
    scaled[:, 2, 3] *= 1.1
    record = record_of(scaled, 0)
    record.keyframes = {k: KeyframeRow(k, k * 10**8, scaled[k], 0.0, submap_id=0) for k in (0, 10)}
    for k in (0, 10):
        record.map_T_kf.add(k, true[k])
    mapped = record.mapped()
    assert mapped is not None
    np.testing.assert_allclose(mapped.poses[:, 2, 3], true[:, 2, 3], atol=1e-4)


def test_frames_located_by_a_keyframe_each_stay_with_it() -> None:
    """An estimator that refers each frame to the last keyframe has no relation to the next one."""
    pnp = dataclasses.replace(Config().odometry, method="pnp")
    record = RunRecord.of(Config(odometry=pnp))
    record.frames = record_of(camera_path()[:10], 0).frames
    record.keyframes = {k: KeyframeRow(k, k * 10**8, camera_path()[k], 0.0, submap_id=0) for k in (0, 10)}
    record.map_T_kf.add(0, camera_path()[0])
    record.map_T_kf.add(10, np.eye(4))
    mapped = record.mapped()
    assert mapped is not None
    np.testing.assert_array_equal(mapped.poses, camera_path()[:10])


def test_one_pose_is_not_compared(tmp_path: Path) -> None:
    record = record_of(camera_path()[:1], 0)
    _, lines, report = results(tmp_path, record, pinhole_rig(), Config())
    assert not any("ground truth" in line or "nan" in line for line in lines) and "nan" not in report


def test_a_straight_path_reports_that_its_rotation_is_undetermined(tmp_path: Path) -> None:
    truth = np.tile(np.eye(4), (COUNT, 1, 1))
    truth[:, 2, 3] = np.arange(COUNT) * 0.1
    truth[:, 0, 3] = 1e-4 * np.sin(np.arange(COUNT))
    straight, curved = (Trajectory(np.arange(COUNT) * 10**8, poses) for poses in (truth, camera_path()))
    for path, message in ((straight, True), (curved, False)):
        rows = dict(table(evaluate(path, path)))
        assert ("nearly straight" in rows["rotation"]) == message


def test_a_loop_rejected_by_the_map_is_not_accepted(tmp_path: Path) -> None:
    record = record_of(camera_path(), 0)
    none = np.zeros(0, np.int64)
    pairs = none.reshape(-1, 2)
    for kf_id in (10, 20):
        record.put(Keyframe(kf_id, kf_id, kf_id * 10**8, np.eye(4), none, *(np.zeros((0, n)) for n in (2, 2, 3)),
                            np.zeros((0, 32), np.uint8)))  # fmt: skip
        record.put(LoopResult(kf_id, 0, np.eye(4), np.eye(6), pairs, 50, 1.0, ""))
    place = np.eye(4)[None]
    update = MapUpdate(9, 20, np.array([20]), place, none, np.zeros((0, 3)), none, pairs, np.eye(4),
                       refused_kf_ids=np.array([10]))  # fmt: skip
    record.put(update)
    assert [loop.kf_id for loop in record.loops] == [20]
    assert record.rejected == {"against_the_map": 1}


def test_the_report_and_the_exit_code_have_the_same_limit(tmp_path: Path) -> None:
    record = record_of(camera_path(), 0)
    for k in range(COUNT, COUNT + 10):  # a quarter is lost
        record.put(
            Frame(k, k * 10**8, np.eye(4), np.eye(6), TrackState.LOST, "dark", Observations.empty(), 0, np.eye(4))
        )
    for limit, wrong in ((20.0, True), (30.0, False)):
        stats, _ = write_results(tmp_path, "test", pinhole_rig(), Config(), record, 1.0, max_lost_percent=limit)
        assert bool(failure(stats)) == wrong
        assert ("FAIL" in (tmp_path / "report.md").read_text()) == wrong


def test_a_report_in_a_hurry_has_its_text_and_the_plots_drawn_so_far(tmp_path: Path) -> None:
    answers = iter([True, False])

    def go_on() -> bool:
        assert "## Time per stage" in (tmp_path / "report.md").read_text()  # before any picture
        return next(answers)

    write_results(tmp_path, "test", pinhole_rig(), Config(), record_of(camera_path(), 0), 1.0, go_on=go_on)
    report = (tmp_path / "report.md").read_text()
    assert "![trajectory](trajectory.png)" in report and "![tracking]" not in report
    assert "plots were omitted" in report
    assert [path.name for path in tmp_path.glob("*.png")] == ["trajectory.png"]


def test_corrections_of_the_rig_are_plotted_and_written(tmp_path: Path) -> None:
    record = record_of(camera_path(), 0)
    none = np.zeros(0, np.int64)
    terms, covariance = np.array([0.002, *[0.0] * 7]), np.diag(np.full(8, 1e-8))
    for k, change in (
        (3, None),
        (6, CalibrationUpdate(1, 6, 6 * 10**8, terms, covariance, 0, True, "significant", "")),
    ):
        rows = RowErrors(k, k * 10**8, np.full(12, 0.1), 0.7 / k, 0.0, False)
        update = MapUpdate(
            k, k, none, np.zeros((0, 4, 4)), none, np.zeros((0, 3)), none, none.reshape(-1, 2), np.eye(4)
        )
        record.put(dataclasses.replace(update, calibration=change, row_errors=rows))
    write_results(tmp_path, "test", pinhole_rig(), Config(), record, 1.0)
    report = (tmp_path / "report.md").read_text()
    assert "![calibration](calibration.png)" in report and "+0.115 ± 0.006" in report
    assert (tmp_path / "calibration.png").exists() and (tmp_path / "rig_corrected.yaml").exists()


def test_a_disk_that_is_full_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")  # as from a file that is open already

    monkeypatch.setattr("stereo_sfm.eval.run_results.write_report", full)
    with pytest.raises(OSError, match="No space") as caught:
        write_results(tmp_path, "test", pinhole_rig(), Config(), record_of(camera_path(), 0), 1.0)
    assert str(from_os_error(caught.value)).startswith(f"cannot write to {tmp_path}: No space left")
    assert (tmp_path / "trajectory_odom.tum").exists()


def test_frames_dropped_by_capture_have_no_pose(tmp_path: Path) -> None:
    record = record_of(camera_path(), 0)
    for k in range(120):
        record.put(Dropped(100 + k, 1, "ring", "no free slot"))
    record.put(Dropped(300, 1, "sensor", "lost", 3))
    stats, _ = write_results(tmp_path, "test", pinhole_rig(), Config(), record, 1.0)
    assert stats["lost_percent"] == pytest.approx(80.0)
    assert "80 % of the frames have no pose (limit 20 %), 120 of them dropped by capture" in failure(stats)
    assert summary(stats)[0].startswith("tracked 30/153 frames (120 dropped by capture, 3 lost before capture)")
    report = (tmp_path / "report.md").read_text()
    assert "**FAIL**: 80 % of the frames have no pose" in report and "120 frames (78.4 %) were dropped" in report


def test_images_missing_in_the_log_are_reported(tmp_path: Path) -> None:
    record = record_of(camera_path(), 0)
    record.put(Dropped(3, 1, "log", "the log is slower than the camera"))
    record.put(LogEnded("recording stopped, No space left on device"))
    stats, _ = write_results(tmp_path, "test", pinhole_rig(), Config(), record, 1.0)
    assert stats["lost_percent"] == 0.0 and failure(stats) == "" and stats["dropped"] == 0
    message = "\n".join(summary(stats))
    assert "the log lacks 1 image:" in message and "the log is not complete: recording stopped" in message
    assert "No space left on device" in (tmp_path / "report.md").read_text()


def test_the_report_links_the_glossary(tmp_path: Path) -> None:
    _, _, report = results(tmp_path, record_of(camera_path(), 0), pinhole_rig(), Config())
    link = re.search(r"\[glossary\]\((.*?)\)", report)
    assert link and (tmp_path / link[1]).is_file()
