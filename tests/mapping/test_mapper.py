"""The mapper on synthetic sequences: drift, re-observed points, frames of reference and reproducibility."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.correction import loop_is_known
from stereo_sfm.mapping.keyframe_poses import KeyframePoses
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.mapper import Mapper, run_job
from stereo_sfm.types import F64, Corners, LoopResult, MapUpdate
from tests.synthetic import KeyframeStream, camera_path, fisheye_rig, keyframe_stream, pinhole_rig

CONFIG = MapperConfig()
LOOP_ALONE = MapperConfig(full_ba_lag_keyframes=3, full_ba_growth=np.inf, association="tracks", final_iterations=0)


def to_and_fro(count: int, reach: int = 10, step: float = 0.1) -> F64:
    """(K, 4, 4) poses of a camera that moves sideways along one shelf, again and again."""
    x = np.abs((np.arange(count) + reach) % (2 * reach) - reach) * step
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = x - x[0]
    return poses


def run(stream: KeyframeStream, config: MapperConfig = CONFIG) -> tuple[Mapper, list[MapUpdate]]:
    mapper = Mapper(config, stream.rig)
    return mapper, [mapper.step(k) for k in stream.keyframes]


def error(poses: F64, truth: F64) -> float:
    """RMSE of positions in metres without alignment: both start at the first true pose."""
    return float(np.sqrt(((poses[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(1).mean()))


def place(count: int) -> KeyframeStream:
    """In one place, with points lost and re-observed and some outliers."""
    return keyframe_stream(fisheye_rig(), to_and_fro(count), points=300, track_length=3, per_keyframe=80, outliers=0.02)


def odometry(stream: KeyframeStream) -> F64:
    return np.array([k.odom_T_cam for k in stream.keyframes])


@pytest.fixture(params=["pinhole", "fisheye"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return pinhole_rig() if request.param == "pinhole" else fisheye_rig()


def test_a_sequence_loses_its_drift(rig: Rig) -> None:
    stream = keyframe_stream(rig, camera_path(18), drift=(0.01, 0.003), outliers=0.03)
    mapper, _ = run(stream)
    assert error(mapper.map.keyframes.map_T_kf, stream.world_T_kf) < 0.4 * error(odometry(stream), stream.world_T_kf)


def test_reobserved_points_bound_the_drift(rig: Rig) -> None:
    """In one place for long: with tracks alone the drift grows, re-observed points bound it."""
    stream = keyframe_stream(rig, to_and_fro(30), points=300, track_length=2, noise_px=0.6, per_keyframe=60)
    with_matches, _ = run(stream)
    without, _ = run(stream, dataclasses.replace(CONFIG, association="tracks"))
    kept = error(with_matches.map.keyframes.map_T_kf, stream.world_T_kf)
    lost = error(without.map.keyframes.map_T_kf, stream.world_T_kf)
    assert kept < 0.6 * lost
    assert len(with_matches.map.living_points()) < 0.7 * len(without.map.living_points())


def test_fused_points_are_truly_one() -> None:
    stream = place(20)
    _, updates = run(stream)
    fused = np.concatenate([u.fused_point_ids for u in updates])
    assert len(fused) > 100
    truth = stream.truth_of_id[fused]
    assert (truth[:, 0] == truth[:, 1]).mean() > 0.99


def test_updates_alone_rebuild_the_map() -> None:
    """Applying every update gives the mapper's poses and points."""
    stream = place(20)
    mapper, updates = run(stream)
    poses = KeyframePoses()
    points: dict[int, F64] = {}
    for version, update in enumerate(updates, start=1):
        assert update.version == version
        poses.update(update)
        points.update(zip(update.point_ids.tolist(), update.points_map, strict=True))
        for gone in [*update.culled_point_ids.tolist(), *update.fused_point_ids[:, 0].tolist()]:
            points.pop(gone, None)
    m = mapper.map
    assert (~m.keyframes.alive).any() and list(poses.all()) == m.keyframes.kf_id.tolist()
    np.testing.assert_allclose(list(poses.all().values()), m.keyframe_poses(), rtol=0, atol=1e-12)
    rows = m.living_keyframes()
    np.testing.assert_array_equal([poses.all()[int(k)] for k in m.keyframes.kf_id[rows]], m.keyframes.map_T_kf[rows])
    rows = m.living_points()
    assert sorted(points) == sorted(m.points.pt_id[rows].tolist())
    np.testing.assert_array_equal([points[int(i)] for i in m.points.pt_id[rows]], m.points.xyz[rows])


def test_map_and_odometry_are_one_frame_before_a_loop() -> None:
    _, updates = run(keyframe_stream(pinhole_rig(), camera_path(6)))
    assert all(np.array_equal(u.map_T_odom, np.eye(4)) for u in updates)


def test_odometry_is_used_without_connecting_tracks(rig: Rig) -> None:
    stream = keyframe_stream(rig, camera_path(10), broken_at=6)
    mapper, _ = run(stream, dataclasses.replace(CONFIG, association="tracks"))
    step = se3.inverse(mapper.map.keyframes.map_T_kf[5]) @ mapper.map.keyframes.map_T_kf[6]
    expected = se3.inverse(stream.world_T_kf[5]) @ stream.world_T_kf[6]
    assert np.linalg.norm(step[:3, 3] - expected[:3, 3]) < 0.02


def test_weak_points_are_culled_and_tracked_ones_kept(rig: Rig) -> None:
    stream = keyframe_stream(rig, camera_path(14), outliers=0.05)
    mapper, updates = run(stream)
    points = mapper.map.points
    old = mapper.map.living_points()
    old = old[points.last_seen[old] < len(stream.keyframes) - 1]
    assert (points.obs_count[old] >= 2).all()
    assert sum(len(u.culled_point_ids) for u in updates) > 0
    truth = stream.points[stream.truth_of_id[points.pt_id[mapper.map.living_points()]]]
    away = np.linalg.norm(points.xyz[mapper.map.living_points()] - truth, axis=1)
    assert np.median(away) < 0.05


def test_keyframes_of_one_place_are_thinned_out() -> None:
    stream = keyframe_stream(
        fisheye_rig(), to_and_fro(30, reach=4, step=0.05), points=200, track_length=8, per_keyframe=80
    )
    mapper, _ = run(stream)
    alive = mapper.map.keyframes.alive
    assert alive.sum() < 25 and alive[0] and alive[-1]
    every, _ = run(stream, dataclasses.replace(CONFIG, redundant_share=2.0))
    assert every.map.keyframes.alive.all()
    assert error(mapper.map.keyframes.map_T_kf, stream.world_T_kf) < 0.02


def test_the_retail_papers_rule_uses_the_previous_keyframe_only() -> None:
    stream = keyframe_stream(fisheye_rig(), camera_path(12))
    paper = dataclasses.replace(CONFIG, association="previous", window_keyframes=0, redundant_share=2.0)
    mapper, updates = run(stream, paper)
    assert sum(len(u.fused_point_ids) for u in updates) == 0
    obs = mapper.map.observations
    for row in range(len(mapper.map.points)):
        seen = np.sort(obs.kf[mapper.map.sightings(np.array([row]))[0]])
        assert len(seen) == 0 or seen[-1] - seen[0] < 8
    assert error(mapper.map.keyframes.map_T_kf, stream.world_T_kf) < error(odometry(stream), stream.world_T_kf)


def bits(value: object) -> object:
    """An array's bytes; of a message the bits of its fields."""
    if dataclasses.is_dataclass(value):
        return [bits(getattr(value, field.name)) for field in dataclasses.fields(value)]
    return value if value is None else np.asarray(value).tobytes()


def test_same_keyframes_same_bits() -> None:
    stream = place(20)
    for first, second in zip(run(stream)[1], run(stream)[1], strict=True):
        for field in dataclasses.fields(MapUpdate):
            assert bits(getattr(first, field.name)) == bits(getattr(second, field.name)), field.name


def test_compaction_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = place(30)
    plain = run(stream)[1]
    monkeypatch.setattr(Map, "much_removed", True)
    compacted, updates = run(stream)
    assert (~compacted.map.points.alive).sum() == 1  # the row that stands for all culled points
    for first, second in zip(plain, updates, strict=True):
        for field in dataclasses.fields(MapUpdate):
            assert bits(getattr(first, field.name)) == bits(getattr(second, field.name)), field.name


def test_rows_of_keyframes_that_loops_name_no_more_are_freed_and_no_bit_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("stereo_sfm.mapping.columns.FEW", 4)
    stream = keyframe_stream(
        fisheye_rig(), to_and_fro(40, reach=4, step=0.05), points=200, track_length=8, per_keyframe=80
    )

    def updates_of(lag: int) -> tuple[Mapper, list[MapUpdate]]:
        mapper, updates = Mapper(CONFIG, stream.rig), list[MapUpdate]()
        for k in stream.keyframes:
            forgotten = np.array([k.kf_id - lag] if k.kf_id > lag else [], np.int64)
            mapped = dataclasses.replace(true_loop(stream, 9, 2), candidate_kf_id=-1, forgotten_kf_ids=forgotten)
            updates.append(mapper.step(k, mapped))
        return mapper, updates

    (every, plain), (some, updates) = updates_of(1000), updates_of(8)
    assert len(every.map.keyframes) == 40
    assert len(some.map.keyframes) < 40 - 8 and some.map.keyframes.kf_id[0] == 0
    for first, second in zip(plain, updates, strict=True):
        for field in dataclasses.fields(MapUpdate):
            assert bits(getattr(first, field.name)) == bits(getattr(second, field.name)), field.name


def test_disabled_mapping_repeats_odometry() -> None:
    stream = keyframe_stream(pinhole_rig(), camera_path(5))
    mapper, updates = run(stream, dataclasses.replace(CONFIG, enabled=False))
    assert len(mapper.map.keyframes) == 0
    for keyframe, update in zip(stream.keyframes, updates, strict=True):
        np.testing.assert_array_equal(update.map_T_kf[0], keyframe.odom_T_cam)
        assert len(update.point_ids) == 0


def ring(count: int) -> F64:
    """(K, 4, 4) one lap on a circle and a little further."""
    return camera_path(count, 0.25, 2 * np.pi / (count - 5))


def true_loop(stream: KeyframeStream, kf: int, candidate: int) -> LoopResult:
    """The result of a perfect loop closer."""
    old = np.unique(np.concatenate([stream.keyframes[k].point_ids for k in range(candidate - 2, candidate + 3)]))
    new = stream.keyframes[kf].point_ids
    _, i, j = np.intersect1d(stream.truth_of_id[old], stream.truth_of_id[new], return_indices=True)
    return LoopResult(
        kf_id=kf,
        candidate_kf_id=candidate,
        candidate_T_kf=se3.inverse(stream.world_T_kf[candidate]) @ stream.world_T_kf[kf],
        information=np.diag([1e4] * 3 + [1e5] * 3),
        matches=np.stack([old[i], new[j]], 1),
        inliers=len(i),
        score=1.0,
        reason="",
    )


def sequence_with_loop(stream: KeyframeStream, elsewhere: bool = False) -> tuple[Mapper, list[MapUpdate]]:
    """One true loop two keyframes before the end; `elsewhere`: the job is computed outside the mapper."""
    mapper, updates = Mapper(LOOP_ALONE, stream.rig), []
    last = len(stream.keyframes)
    for keyframe in stream.keyframes:
        loop = true_loop(stream, last - 8, 2) if keyframe.kf_id == last - 6 else None
        updates.append(mapper.step(keyframe, loop))
        job = mapper.pending_job()
        if elsewhere and job is not None:
            mapper.finish_job(run_job(job))
    return mapper, updates


def drifting_ring(seed: int) -> KeyframeStream:
    return keyframe_stream(
        pinhole_rig(), ring(40), points=800, noise_px=1.0, drift=(0.01, 0.003), per_keyframe=100, track_length=3,
        seed=seed,
    )  # fmt: skip


def test_a_loop_corrects_the_map() -> None:
    """In the mean of four sequences: the drift of a single one is chance."""
    whole, end = np.zeros((2, 2))  # without and with the loop
    for seed in range(4):
        stream = drifting_ring(seed)
        opened, _ = run(stream, dataclasses.replace(CONFIG, association="tracks"))
        for k, mapper in enumerate((opened, sequence_with_loop(stream)[0])):
            poses = mapper.map.keyframes.map_T_kf
            whole[k] += error(poses, stream.world_T_kf)
            end[k] += error(poses[-8:], stream.world_T_kf[-8:])
    assert whole[1] < 0.8 * whole[0] and end[1] < 0.9 * end[0]


def test_a_loop_moves_the_map_and_not_the_odometry() -> None:
    _, updates = sequence_with_loop(drifting_ring(2))
    closing = next(i for i, u in enumerate(updates) if not np.array_equal(u.map_T_odom, np.eye(4)))
    before, after = updates[closing - 1], updates[closing]
    # The newest keyframe before the loop stays where it was in the odometry frame.
    newest = int(before.kf_id)
    old = {int(k): p for u in updates[:closing] for k, p in zip(u.kf_ids, u.map_T_kf, strict=True)}[newest]
    new = after.map_T_kf[int(np.flatnonzero(after.kf_ids == newest)[0])]
    jump = se3.inverse(se3.inverse(after.map_T_odom) @ new) @ se3.inverse(before.map_T_odom) @ old
    assert np.linalg.norm(se3.log(jump)) < 0.02
    assert np.linalg.norm(new[:3, 3] - old[:3, 3]) > 0.01


def test_the_last_full_adjustment_converges() -> None:
    """Another one moves the keyframes much less than the last one did, in the mean of four sequences."""
    moved = np.zeros(2)
    for seed in range(4):
        stream = keyframe_stream(pinhole_rig(), ring(26), noise_px=0.5, per_keyframe=60, seed=seed)
        mapper, _ = run(stream)
        for k in range(2):
            before = mapper.map.keyframes.map_T_kf[:, :3, 3].copy()
            mapper.finish([])
            moved[k] += np.linalg.norm(mapper.map.keyframes.map_T_kf[:, :3, 3] - before, axis=1).max()
    assert moved[1] < 0.5 * moved[0]


def test_without_a_last_full_adjustment_the_map_stays() -> None:
    config = dataclasses.replace(CONFIG, final_iterations=0, full_ba_growth=np.inf)
    mapper, _ = run(keyframe_stream(pinhole_rig(), ring(12), noise_px=0.5), config)
    before = mapper.map.keyframes.map_T_kf.copy()
    mapper.finish([])
    assert np.array_equal(mapper.map.keyframes.map_T_kf, before)


def test_full_adjustment_gives_the_same_bits_wherever_it_runs() -> None:
    stream = keyframe_stream(pinhole_rig(), ring(26), drift=(0.01, 0.003), per_keyframe=60)
    here, there = sequence_with_loop(stream)[0].map, sequence_with_loop(stream, elsewhere=True)[0].map
    assert here.keyframes.map_T_kf.tobytes() == there.keyframes.map_T_kf.tobytes()
    assert here.points.xyz.tobytes() == there.points.xyz.tobytes()


def test_a_known_loop_only_fuses_points(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = keyframe_stream(pinhole_rig(), ring(40), points=800, per_keyframe=100, track_length=3)
    mapper, _ = sequence_with_loop(stream)
    mapper.finish([])
    again = true_loop(stream, len(stream.keyframes) - 8, 2)
    assert loop_is_known(mapper.map, again)
    monkeypatch.setattr("stereo_sfm.mapping.mapper.apply_loop", lambda *_: pytest.fail("the pose graph ran"))
    assert mapper.finish([again]) is not None
    wrong = dataclasses.replace(again, candidate_T_kf=again.candidate_T_kf @ se3.exp(np.array([0.1, 0, 0, 0, 0, 0])))
    assert not loop_is_known(mapper.map, wrong)


def test_a_loop_that_contradicts_the_map_is_rejected_and_reported() -> None:
    stream = keyframe_stream(pinhole_rig(), ring(40), points=800, per_keyframe=100, track_length=3)
    mapper, _ = sequence_with_loop(stream)
    mapper.finish([])
    before = mapper.map.keyframes.map_T_kf.copy()
    loop = true_loop(stream, len(stream.keyframes) - 8, 2)
    false = dataclasses.replace(loop, candidate_T_kf=loop.candidate_T_kf @ se3.exp(np.array([2.0, 0, 0, 0, 0, 0])))
    update = mapper.finish([false])
    assert update is not None and update.refused_kf_ids.tolist() == [false.kf_id]
    assert np.array_equal(mapper.map.keyframes.map_T_kf, before)
    assert mapper.finish([]).refused_kf_ids.tolist() == []  # type: ignore[union-attr]


def test_no_limit_of_the_window_takes_all_keyframes() -> None:
    stream = keyframe_stream(pinhole_rig(), ring(12), points=400, per_keyframe=100, track_length=3)
    all_, many = (run(stream, dataclasses.replace(CONFIG, window_keyframes=n))[0].map for n in (0, 1000))
    assert all_.keyframes.map_T_kf.tobytes() == many.keyframes.map_T_kf.tobytes()


def test_a_place_keeps_a_bounded_number_of_keyframes() -> None:
    """Back and forth along one wall: new tracks every time, so no keyframe is redundant by its points."""
    once = camera_path(12, 0.1, 0.0)
    stream = keyframe_stream(pinhole_rig(), np.concatenate([once, once[::-1]] * 6), points=600, track_length=4)
    bounded, _ = run(stream, dataclasses.replace(CONFIG, redundant_share=0.999))
    every, _ = run(stream, dataclasses.replace(CONFIG, redundant_share=2.0))
    assert len(every.map.living_keyframes()) == len(stream.keyframes)
    assert len(bounded.map.living_keyframes()) < 0.6 * len(stream.keyframes)
    assert error(bounded.map.keyframes.map_T_kf, stream.world_T_kf) < 0.006


def test_of_each_view_a_keyframe_by_which_places_are_recognised_stays() -> None:
    """Slowly along a wall: of all keyframes every fourth has corners, and all but a few are redundant."""
    stream = keyframe_stream(pinhole_rig(), camera_path(60, 0.03, 0.0), points=600)
    marks = dataclasses.replace(
        Corners.none(),
        uv_left=np.full((1, 2), 50, np.float32), uv_right=np.full((1, 2), 40, np.float32),
        points_cam=np.ones((1, 3), np.float32), descriptors=np.ones((1, 32), np.uint8),
    )  # fmt: skip
    keyframes = [dataclasses.replace(k, corners=marks) if n % 4 == 2 else k for n, k in enumerate(stream.keyframes)]
    stream = dataclasses.replace(stream, keyframes=keyframes)
    mapper, _ = run(stream, dataclasses.replace(CONFIG, redundant_share=0.5))
    map_ = mapper.map
    living = map_.living_keyframes()
    described = [row for row in living.tolist() if len(map_.corners[row][0])]
    assert len(living) < 35
    marked = list(range(2, 50, 4))
    at = stream.world_T_kf[:, :3, 3]
    away = np.linalg.norm(at[marked, None] - at[None, described], axis=2).min(1)
    assert away.max() < 0.5


def test_ends_of_loops_are_thinned_out_too() -> None:
    """Back and forth with a loop at every return: the loops end at other keyframes where theirs are culled."""
    once = camera_path(12, 0.1, 0.0)
    poses = np.concatenate([once, once[::-1]] * 4)
    stream = keyframe_stream(pinhole_rig(), poses, points=600, drift=(0.005, 0.001), track_length=4)
    config = dataclasses.replace(CONFIG, association="tracks", full_ba_growth=np.inf)
    mapper, none = Mapper(config, stream.rig), np.zeros((0, 2), np.int64)
    for k, keyframe in enumerate(stream.keyframes):
        returned = dataclasses.replace(true_loop(stream, k - 1, k - 25), matches=none) if k >= 27 else None
        mapper.step(keyframe, returned)
    mapper.finish([])
    assert len(mapper.map.living_keyframes()) < 0.85 * len(stream.keyframes)
    assert error(mapper.map.keyframes.map_T_kf, stream.world_T_kf) < 0.02


def test_visits_that_share_no_points_are_thinned_out_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Back and forth, each time with new points: a view keeps a bounded number of keyframes of all visits."""
    once = camera_path(12, 0.1, 0.0)
    visits = 8
    poses = np.concatenate([once if k % 2 == 0 else once[::-1] for k in range(visits)])
    stream = keyframe_stream(pinhole_rig(), poses, points=600, track_length=4)
    config = dataclasses.replace(CONFIG, association="tracks", full_ba_growth=np.inf)
    bounded, _ = run(stream, config)
    monkeypatch.setattr("stereo_sfm.mapping.culling.OF_A_VIEW", 10_000)
    every, _ = run(stream, config)
    assert len(every.map.living_keyframes()) > 0.7 * len(poses)
    assert len(bounded.map.living_keyframes()) < 0.5 * len(poses)


def test_of_many_views_seen_again_a_limited_number_is_kept_besides_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereo_sfm.mapping.culling.PASSED", 5)
    monkeypatch.setattr("stereo_sfm.mapping.culling.OF_A_VIEW", 10_000)
    once = camera_path(12, 0.1, 0.0)
    poses = np.concatenate([once if k % 2 == 0 else once[::-1] for k in range(8)])
    stream = keyframe_stream(pinhole_rig(), poses, points=600, track_length=4)
    config = dataclasses.replace(CONFIG, association="tracks", full_ba_growth=np.inf)
    every, _ = run(stream, config)
    monkeypatch.setattr("stereo_sfm.mapping.culling.OF_EARLIER_VISITS", 10)
    few, _ = run(stream, config)
    assert len(every.map.living_keyframes()) > 0.7 * len(poses)
    assert len(few.map.living_keyframes()) < 0.5 * len(poses)
    assert error(few.map.keyframes.map_T_kf, stream.world_T_kf) < 0.02


def test_a_keyframe_that_lost_its_points_is_not_adjusted_but_goes() -> None:
    """A few wrong points would pull it metres away; its pose stays as it was beside its neighbours."""
    stream = keyframe_stream(pinhole_rig(), camera_path(50, 0.1, 0.0), points=600)
    mapper, _ = run(stream, dataclasses.replace(CONFIG, full_ba_growth=np.inf, final_iterations=0, redundant_share=1.0))
    map_ = mapper.map
    row = int(map_.living_keyframes()[8])
    seen = map_.observations_of_keyframe(row)
    pose, left = map_.keyframes.map_T_kf[row].copy(), seen[:5]
    map_.remove_observations(seen[5:])
    map_.move_points(map_.observations.pt[left].astype(np.int64), map_.points.xyz[map_.observations.pt[left]] + 0.5)
    living = len(map_.living_keyframes())
    mapper._start_full_bundle()
    mapper.finish([])
    assert not map_.keyframes.alive[row] and len(map_.living_keyframes()) == living - 1
    assert np.linalg.norm((map_.keyframe_poses()[row] - pose)[:3, 3]) < 0.01
