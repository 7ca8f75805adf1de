"""Bundle adjustment against exact truth, against GTSAM, and its solvers against each other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Epipolar
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, adjust_pose, bundle_adjust
from tests import gtsam_oracle
from tests.synthetic import Scene, disturb, fisheye_rig, make_scene, pinhole_rig

TIGHT = BundleConfig(rounds=1, huber=0, tolerance=1e-12, iterations=50)


def bundle_of(scene: Scene, pose_sigma: float = 0.01, point_sigma: float = 0.03) -> Bundle:
    poses, points = disturb(scene, pose_sigma, point_sigma)
    fixed = np.zeros(len(poses), bool)
    fixed[0] = True
    return Bundle(poses, fixed, points, scene.obs_kf, scene.obs_pt, scene.uv_left, scene.uv_right)


def stereo_only_u(scene: Scene) -> Scene:
    """The right row unseen, as GenericStereoFactor3D has it."""
    right = scene.uv_right.copy()
    right[:, 1] = np.nan
    return dataclasses.replace(scene, uv_right=right)


@pytest.fixture(params=["pinhole", "fisheye", "epipolar"])
def rig(request: pytest.FixtureRequest) -> Rig:
    if request.param == "epipolar":
        cam = Epipolar(900, 600, 300.0, 300.0, 450.0, 300.0)
        return dataclasses.replace(pinhole_rig(), left=cam, right=cam)
    return pinhole_rig() if request.param == "pinhole" else fisheye_rig()


@pytest.mark.parametrize("depth", [False, True])
def test_noise_free_scene_returns_to_truth(rig: Rig, depth: bool) -> None:
    rig = dataclasses.replace(rig, depth=depth)
    scene = make_scene(rig, 6, 300, noise_px=0.0)
    result = bundle_adjust(rig, bundle_of(scene), TIGHT)
    assert result.cost < 1e-12
    np.testing.assert_allclose(result.world_T_kf, scene.world_T_kf, atol=1e-8)
    seen = np.flatnonzero(np.bincount(scene.obs_pt) >= 2)  # more than one ray
    np.testing.assert_allclose(result.points[seen], scene.points[seen], atol=1e-5)
    assert result.converged


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("huber", [0.0, 1.345])
def test_agrees_with_gtsam_on_rectified_stereo(huber: float, depth: bool) -> None:
    """A depth camera's computed right pixel has the error of the left one besides its own."""
    rig = dataclasses.replace(pinhole_rig(), depth=depth)
    scene = stereo_only_u(make_scene(rig, 5, 150, noise_px=0.7, outliers=0.03 if huber else 0.0))
    bundle = bundle_of(scene)
    graph = gtsam_oracle.stereo_graph(rig, bundle, huber)
    expected = gtsam_oracle.optimize(graph, gtsam_oracle.start_values(bundle))
    result = bundle_adjust(rig, bundle, dataclasses.replace(TIGHT, huber=huber, joint_loss=True))
    assert result.cost == pytest.approx(graph.error(expected), rel=1e-3)
    np.testing.assert_allclose(result.world_T_kf, gtsam_oracle.poses(expected, 5), atol=1e-4)


@pytest.mark.parametrize("huber", [0.0, 1.345])
def test_agrees_with_gtsam_on_fisheye(huber: float) -> None:
    rig = fisheye_rig()
    scene = make_scene(rig, 5, 120, noise_px=0.7)
    cam = (scene.points[scene.obs_pt] - scene.world_T_kf[scene.obs_kf, :3, 3])[:, None] @ scene.world_T_kf[
        scene.obs_kf, :3, :3
    ]
    front = cam[:, 0, 2] > 0.5  # GTSAM's fisheye divides by the depth
    scene = dataclasses.replace(
        scene,
        obs_kf=scene.obs_kf[front],
        obs_pt=scene.obs_pt[front],
        uv_left=scene.uv_left[front],
        uv_right=scene.uv_right[front],
    )
    bundle = bundle_of(scene)
    graph = gtsam_oracle.fisheye_graph(rig, bundle, huber)
    expected = gtsam_oracle.optimize(graph, gtsam_oracle.start_values(bundle))
    result = bundle_adjust(rig, bundle, dataclasses.replace(TIGHT, huber=huber))
    assert result.cost == pytest.approx(graph.error(expected), rel=1e-3)
    np.testing.assert_allclose(result.world_T_kf, gtsam_oracle.poses(expected, 5), atol=1e-4)


def test_sparse_and_dense_solvers_agree(rig: Rig) -> None:
    bundle = bundle_of(make_scene(rig, 20, 400, noise_px=0.5))
    dense = bundle_adjust(rig, bundle, dataclasses.replace(TIGHT, dense=True))
    sparse = bundle_adjust(rig, bundle, dataclasses.replace(TIGHT, dense=False))
    assert sparse.cost == pytest.approx(dense.cost, rel=1e-9)
    np.testing.assert_allclose(sparse.world_T_kf, dense.world_T_kf, atol=1e-6)


def test_longer_steps_converge_in_fewer(rig: Rig) -> None:
    bundle = bundle_of(make_scene(rig, 20, 400, noise_px=0.5, outliers=0.1))
    config = BundleConfig(rounds=2, iterations=200, cauchy=0.58, tolerance=1e-9, outlier_chi2=100.0)
    short, long = (bundle_adjust(rig, bundle, dataclasses.replace(config, extend=extend)) for extend in (False, True))
    assert short.converged and long.converged
    assert long.iterations <= 0.7 * short.iterations
    assert long.cost <= short.cost * (1 + 1e-5)
    np.testing.assert_allclose(long.world_T_kf, short.world_T_kf, atol=1e-4)


def test_outliers_are_rejected_and_do_not_bias(rig: Rig) -> None:
    scene = make_scene(rig, 10, 600, noise_px=0.5, outliers=0.1)
    clean = make_scene(rig, 10, 600, noise_px=0.5)
    result = bundle_adjust(rig, bundle_of(scene), BundleConfig(rounds=3))
    reference = bundle_adjust(rig, bundle_of(clean), BundleConfig(rounds=3))
    counts = np.bincount(scene.obs_pt, minlength=len(scene.points))[scene.obs_pt]
    wrong = scene.outlier & (counts >= 4)
    right = ~scene.outlier & (counts >= 4)
    assert result.inlier[wrong, 0].mean() < 0.05
    assert result.inlier[right, 0].mean() > 0.97
    error = np.linalg.norm(result.world_T_kf[:, :3, 3] - scene.world_T_kf[:, :3, 3], axis=1).max()
    bound = np.linalg.norm(reference.world_T_kf[:, :3, 3] - scene.world_T_kf[:, :3, 3], axis=1).max()
    assert error < 1.5 * bound + 1e-3


def test_a_fixed_part_linearised_once_a_round_leads_to_the_same_window(rig: Rig) -> None:
    scene = make_scene(rig, 14, 500, noise_px=0.5, outliers=0.02)
    bundle = bundle_of(scene, 0.01, 0.02)
    fixed = np.arange(14) < 8
    bundle = dataclasses.replace(bundle, fixed=fixed)
    bundle.world_T_kf[fixed] = scene.world_T_kf[fixed]
    exact = bundle_adjust(rig, bundle, BundleConfig(rounds=3, tolerance=1e-9, iterations=30))
    once = bundle_adjust(rig, bundle, BundleConfig(rounds=3, tolerance=1e-9, iterations=30, fixed_once=True))
    error = np.linalg.norm(exact.world_T_kf[:, :3, 3] - scene.world_T_kf[:, :3, 3], axis=1).max()
    apart = np.linalg.norm(exact.world_T_kf[:, :3, 3] - once.world_T_kf[:, :3, 3], axis=1).max()
    assert apart < 0.1 * error
    assert once.cost == pytest.approx(exact.cost, rel=1e-3)
    assert (once.inlier != exact.inlier).mean() < 1e-3


def test_fixed_keyframes_stay_to_the_bit(rig: Rig) -> None:
    bundle = bundle_of(make_scene(rig, 8, 200))
    fixed = np.array([True, False, True, False, False, True, False, False])
    result = bundle_adjust(rig, dataclasses.replace(bundle, fixed=fixed))
    assert np.array_equal(result.world_T_kf[fixed], bundle.world_T_kf[fixed])
    assert not np.allclose(result.world_T_kf[~fixed], bundle.world_T_kf[~fixed], atol=1e-6)
    everything = bundle_adjust(rig, dataclasses.replace(bundle, fixed=np.ones(8, bool)))
    assert np.array_equal(everything.world_T_kf, bundle.world_T_kf)
    assert everything.cost < everything.initial_cost


def test_a_single_pose_is_found_among_outliers_and_only_they_are_rejected(rig: Rig) -> None:
    scene = make_scene(rig, 6, 300, noise_px=0.3, outliers=0.1)
    for k in range(6):
        mine = scene.obs_kf == k
        points, left, right = scene.points[scene.obs_pt[mine]], scene.uv_left[mine], scene.uv_right[mine]
        start = scene.world_T_kf[k] @ se3.exp(np.array([0.05, -0.03, 0.04, 0.01, 0.02, -0.01]))
        pose, inlier = adjust_pose(rig, start, points, left, right, np.full(len(points), 0.3), 2.0)
        np.testing.assert_allclose(pose, scene.world_T_kf[k], atol=5e-3)
        assert not inlier[scene.outlier[mine], 0].any()
        assert inlier[~scene.outlier[mine], 0].mean() > 0.97


def test_a_single_pose_is_that_of_a_bundle_with_fixed_points(rig: Rig) -> None:
    """Many fixed keyframes that saw the points exactly hold them where they are."""
    scene = make_scene(rig, 1, 200, noise_px=0.3)
    points, left, right = scene.points[scene.obs_pt], scene.uv_left, scene.uv_right
    start = scene.world_T_kf[0] @ se3.exp(np.array([0.02, -0.01, 0.02, 0.01, 0.0, -0.01]))
    pose, _ = adjust_pose(rig, start, points, left, right, np.full(len(points), 0.3), 2.0)
    assert rig.right is not None
    count, rows = len(points), np.arange(len(points))
    exact = rig.left.project(se3.transform(se3.inverse(scene.world_T_kf[0]), points))
    right_T_world = se3.inverse(scene.world_T_kf[0] @ rig.left_T_right)
    bundle = Bundle(
        np.stack([start, scene.world_T_kf[0]]), np.array([False, True]), points, np.repeat([0, 1], count),
        np.concatenate([rows, rows]), np.concatenate([left, exact]),
        np.concatenate([right, rig.right.project(se3.transform(right_T_world, points))]),
        np.repeat([[0.3, 0.3], [1e-4, 1e-4]], count, axis=0),
    )  # fmt: skip
    result = bundle_adjust(rig, bundle, BundleConfig(rounds=3, huber=2.0))
    np.testing.assert_allclose(pose, result.world_T_kf[0], atol=1e-4)


def test_order_of_observations_does_not_matter(rig: Rig) -> None:
    bundle = bundle_of(make_scene(rig, 5, 150, outliers=0.05))
    order = np.random.default_rng(3).permutation(len(bundle.obs_kf))
    mixed = dataclasses.replace(
        bundle,
        **{name: getattr(bundle, name)[order] for name in ("obs_kf", "obs_pt", "uv_left", "uv_right")},
    )
    first, second = bundle_adjust(rig, bundle), bundle_adjust(rig, mixed)
    np.testing.assert_allclose(first.points, second.points, atol=1e-6)
    assert (first.inlier[order] == second.inlier).mean() > 0.999


def test_same_input_same_bits(rig: Rig) -> None:
    bundle = bundle_of(make_scene(rig, 8, 300, outliers=0.05))
    for dense in (True, False):
        config = BundleConfig(dense=dense)
        first, second = bundle_adjust(rig, bundle, config), bundle_adjust(rig, bundle, config)
        assert first.world_T_kf.tobytes() == second.world_T_kf.tobytes()
        assert first.points.tobytes() == second.points.tobytes()


def test_sigma_weighs_observations(rig: Rig) -> None:
    scene = make_scene(rig, 6, 300, noise_px=0.2)
    left = scene.uv_left.copy()
    bad = scene.obs_kf % 2 == 1
    left[bad] += np.random.default_rng(0).normal(0, 5, (int(bad.sum()), 2))
    bundle = dataclasses.replace(bundle_of(scene), uv_left=left)
    sigma = np.full((len(left), 2), 0.2)
    sigma[bad, 0] = 5.0
    config = dataclasses.replace(TIGHT, huber=0)
    plain = bundle_adjust(rig, bundle, config)
    weighed = bundle_adjust(rig, dataclasses.replace(bundle, sigma=sigma), config)

    def error(poses: np.ndarray) -> float:
        return float(np.linalg.norm(poses[:, :3, 3] - scene.world_T_kf[:, :3, 3]))

    assert error(weighed.world_T_kf) < 0.5 * error(plain.world_T_kf)


def test_undetermined_points_and_keyframes_stay(rig: Rig) -> None:
    """A point on one ray and a keyframe without observations are not errors."""
    scene = make_scene(rig, 5, 100)
    bundle = bundle_of(scene)
    keep = (bundle.obs_kf != 3) & (bundle.obs_pt != 7)
    row = int(np.flatnonzero(scene.obs_kf == 0)[0])
    bundle = dataclasses.replace(
        bundle,
        obs_kf=np.append(bundle.obs_kf[keep], 0),
        obs_pt=np.append(bundle.obs_pt[keep], 7),
        uv_left=np.vstack([bundle.uv_left[keep], scene.uv_left[row]]),
        uv_right=np.vstack([bundle.uv_right[keep], [[np.nan, np.nan]]]),
    )
    result = bundle_adjust(rig, bundle)
    assert np.isfinite(result.points).all()
    np.testing.assert_allclose(result.world_T_kf[3], bundle.world_T_kf[3], atol=1e-12)
    assert not result.inlier[-1, 1]


def test_bad_tables_are_refused() -> None:
    rig = pinhole_rig()
    bundle = bundle_of(make_scene(rig, 3, 50))
    with pytest.raises(StereoSfmError, match="different lengths"):
        bundle_adjust(rig, dataclasses.replace(bundle, obs_kf=bundle.obs_kf[:-1]))
    with pytest.raises(StereoSfmError, match="keyframe that does not exist"):
        bundle_adjust(rig, dataclasses.replace(bundle, obs_kf=bundle.obs_kf + 1))


def test_an_empty_bundle_is_unchanged() -> None:
    rig = pinhole_rig()
    none = np.zeros(0, np.int64)
    bundle = Bundle(
        np.eye(4)[None], np.zeros(1, bool), np.zeros((2, 3)), none, none, np.zeros((0, 2)), np.zeros((0, 2))
    )
    result = bundle_adjust(rig, bundle)
    assert result.cost == 0.0 and np.array_equal(result.points, bundle.points)


def test_a_redescending_loss_is_not_biased_by_one_sided_errors(rig: Rig) -> None:
    """A fifth of the right pixels errs by two pixels to one side, as at depth edges: the size of the scene stays."""
    scene = make_scene(rig, 6, 300, noise_px=0.3)
    right = scene.uv_right.copy()
    right[::5, 0] += 2.0
    scene = dataclasses.replace(scene, uv_right=right)
    spread = np.linalg.norm(np.diff(scene.world_T_kf[:, :3, 3], axis=0), axis=1).sum()
    errors: list[float] = []
    for cauchy in (0.0, 0.58):
        config = BundleConfig(rounds=2, huber=0.75, cauchy=cauchy, iterations=30, outlier_chi2=1e9)
        result = bundle_adjust(rig, bundle_of(scene), config)
        found = np.linalg.norm(np.diff(result.world_T_kf[:, :3, 3], axis=0), axis=1).sum()
        errors.append(abs(found / spread - 1))
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.parametrize("biased", [0.0, 0.25])
def test_points_whose_disparity_always_errs_to_one_side_do_not_shorten_the_path(rig: Rig, biased: float) -> None:
    """Small errors, alike in all observations of a point, as at depth edges; without them nothing changes."""
    rng = np.random.default_rng(3)
    scene = make_scene(rig, 6, 300, noise_px=0.2)
    error = np.where(rng.random(len(scene.points)) < biased, 0.4, 0.0)
    right = scene.uv_right.copy()
    right[:, 0] -= error[scene.obs_pt]  # nearer
    scene = dataclasses.replace(scene, uv_right=right)
    truth = np.linalg.norm(np.diff(scene.world_T_kf[:, :3, 3], axis=0), axis=1).sum()
    config, errors = BundleConfig(rounds=2, huber=2.0, cauchy=0.58, iterations=30), list[float]()
    for sigmas in (0.0, 1.5):
        result = bundle_adjust(rig, bundle_of(scene), dataclasses.replace(config, disparity_sigmas=sigmas))
        errors.append(np.linalg.norm(np.diff(result.world_T_kf[:, :3, 3], axis=0), axis=1).sum() / truth - 1)
    if biased:
        assert errors[0] < -2e-3 and abs(errors[1]) < 0.6 * abs(errors[0])
    else:
        assert max(np.abs(errors)) < 2e-3
