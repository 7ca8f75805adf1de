"""Shortest paths between keyframes over odometry and loops, and motion over gaps in tracking."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.loop.graph import FEWEST, KeyframeGraph
from stereo_sfm.types import F64


def at(x: float, turn: float = 0.0) -> F64:
    """A camera x metres along the aisle, turned by so many radians."""
    return se3.exp(np.array([x, 0, 0, 0, 0, 0])) @ se3.exp(np.array([0, 0, 0, 0, turn, 0]))


def test_a_path_without_loops_is_the_odometry_and_its_length() -> None:
    graph = KeyframeGraph()
    for k, x in enumerate((0.0, 1.0, 2.5)):
        graph.add(k, at(x), 0)
    path = graph.path(0, 2)
    assert path is not None and path.metres == pytest.approx(2.5)
    np.testing.assert_allclose(path.a_T_b, at(2.5), atol=1e-12)


def test_a_path_over_odometry_in_doubt_is_as_uncertain() -> None:
    graph = KeyframeGraph()
    for k, metres in enumerate((0.0, 0.3, 0.4, 0.0)):
        graph.add(k, at(float(k)), 0, doubt=np.array([metres**2, 0.0]))
    for ends, sigma in (((0, 2), 0.5), ((3, 1), 0.4), ((2, 3), 0.0)):
        path = graph.path(*ends)
        assert path is not None
        np.testing.assert_allclose(path.sigmas, [sigma, 0.0], atol=1e-12)


def test_a_loop_shortens_the_path() -> None:
    graph = KeyframeGraph()
    for k in range(20):
        graph.add(k, at(float(k)), 0)
    graph.add_loop(0, 19, at(0.1))
    path = graph.path(1, 19)
    assert path is not None and path.metres == pytest.approx(1.0)
    np.testing.assert_allclose(path.a_T_b, at(-0.9), atol=1e-12)


def test_no_path_over_a_loss_of_tracking_until_a_loop_connects_the_submaps() -> None:
    graph = KeyframeGraph()
    graph.add(0, at(0.0), 0)
    graph.add(1, at(5.0), 1)
    assert graph.path(0, 1) is None
    graph.add_loop(0, 1, at(0.2))
    assert graph.path(0, 1) is not None


def test_the_nearest_keyframe_with_the_same_direction_is_found() -> None:
    graph = KeyframeGraph()
    for k, pose in enumerate((at(0.0), at(1.0), at(1.2, 2.0), at(9.0), at(1.1))):
        graph.add(k, pose, 0)
    assert graph.nearby(4, {4}) == [1]
    assert graph.nearby(4, {0, 1, 4}) == []  # 2 is near but looks away, 3 is far


def test_the_same_view_is_the_same_place_and_direction() -> None:
    graph = KeyframeGraph()
    for k, pose in enumerate((at(0.0), at(0.2), at(0.1, 1.0), at(4.0))):
        graph.add(k, pose, 0)
    assert graph.same_view(0) == [0, 1]


def test_a_keyframe_has_its_own_view_even_where_its_pose_is_no_rotation() -> None:
    graph, stretched = KeyframeGraph(), at(0.0)
    stretched[:3, :3] *= 0.9  # as far from a rotation as after hundreds of products
    graph.add(0, stretched, 0)
    assert graph.same_view(0) == [0]


def test_the_same_view_is_found_in_spite_of_drift_once_a_loop_is_known() -> None:
    graph = KeyframeGraph()
    graph.add(0, at(0.0), 0)
    graph.add(1, at(30.0), 0)
    graph.add(2, at(0.5), 0)  # it stands where 0 stood: odometry has drifted by half a metre
    assert graph.same_view(0) == [0]
    graph.add_loop(0, 2, at(0.0))
    graph.add(3, at(0.6), 0)
    assert graph.same_view(0) == [0, 2, 3]


def test_poses_of_unconnected_submaps_are_not_compared() -> None:
    graph = KeyframeGraph()
    graph.add(0, at(0.0), 0)
    graph.add(1, at(0.0), 1)  # tracking broke: the numbers are the same, the place is not known
    assert graph.same_view(1) == [1]
    assert graph.nearby(1, {1}) == []
    graph.add_loop(0, 1, at(0.1))
    graph.add(2, at(0.05), 1)
    assert graph.same_view(0) == [0, 1, 2]


def test_the_graph_grows_beyond_its_first_allocation() -> None:
    graph = KeyframeGraph()
    for k in range(200):
        graph.add(k, at(k % 10 * 1.0), 0)
    assert graph.same_view(150) == list(range(0, 200, 10))


def broken(seconds: float) -> KeyframeGraph:
    """A metre a second along x for 5 s, then `seconds` without tracking; keyframe 6 starts a new submap."""
    graph = KeyframeGraph()
    for k in range(6):
        graph.add(k, at(float(k)), 0, k * 10**9)
    graph.add(6, np.eye(4), 1, round((5 + seconds) * 1e9))
    return graph


def test_a_second_before_the_gap_may_be_disturbed() -> None:
    gap_motion = broken(1.0).gap_motion(3, 6, at(2.0))
    assert gap_motion is not None and gap_motion.disturbed == pytest.approx(gap_motion.tolerance + 0.75)


@pytest.mark.parametrize(("moved", "possible"), [(0.0, True), (1.0, True), (1.5, True), (-1.4, False), (3.4, False)])
def test_tolerance_of_the_motion_over_a_gap(moved: float, possible: bool) -> None:
    gap_motion = broken(1.0).gap_motion(3, 6, at(2.0 + moved))
    assert gap_motion is not None
    assert gap_motion.deviation == pytest.approx(abs(moved - 0.5)) and gap_motion.distance == pytest.approx(2.0)
    assert (gap_motion.deviation - 0.3 < gap_motion.tolerance) == possible


def test_keyframes_that_are_no_candidates_are_forgotten_and_paths_between_the_others_stay() -> None:
    """Round and round a place of 40 keyframes: those of the first lap stay candidates, each lap closes two loops."""
    graph, whole, lap = KeyframeGraph(), KeyframeGraph(), 40
    poses = [at(0.5 * (k % lap), 2 * np.pi * (k % lap) / lap) for k in range(60 * lap)]
    for k, pose in enumerate(poses):
        for g in (graph, whole):
            g.add(k, pose, k >= 30 * lap, 10**8 * k)
            if k >= lap and k % 20 == 0:
                g.add_loop(k % lap, k, at(0.0))
        if k >= lap:
            graph.exclude(k)
        graph.forget()
    assert len(whole.around(k)[0]) == 60 * lap
    ids, _ = graph.around(k)
    assert len(ids) < FEWEST + 200
    assert np.isin(np.arange(lap), ids).all()
    for other in (5, 33, k - 7):
        path, expected = graph.path(other, k), whole.path(other, k)
        assert path is not None and expected is not None and path.metres == pytest.approx(expected.metres)
        np.testing.assert_allclose(path.a_T_b, expected.a_T_b, atol=1e-9)
    assert graph.unbroken(k - 50, k) and not graph.unbroken(3, k)


def test_a_day_of_loops_to_an_earlier_part_of_the_odometry_needs_no_more_room() -> None:
    """A saved map, and round and round in it: every loop joins two parts of the odometry."""
    graph, lap = KeyframeGraph(), 40
    rows = list[int]()
    for k in range(250 * lap):
        graph.add(k, at(0.5 * (k % lap), 2 * np.pi * (k % lap) / lap), k >= lap, 10**8 * k)
        if k >= lap:
            graph.exclude(k)
            if k % 4 == 0:
                graph.add_loop(k % lap, k, at(0.0))
        graph.forget()
        rows.append(len(graph.around(k)[0]))
    assert max(rows[len(rows) // 2 :]) <= max(rows[: len(rows) // 2]) < 2 * FEWEST
    path = graph.path(5, k)
    assert path is not None
    np.testing.assert_allclose(
        path.a_T_b, se3.inverse(at(2.5, 2 * np.pi * 5 / lap)) @ at(19.5, 2 * np.pi * 39 / lap), atol=1e-9
    )


def test_the_gap_is_symmetric() -> None:
    graph = broken(1.0)
    there, back = graph.gap_motion(3, 6, at(2.7)), graph.gap_motion(6, 3, at(-2.7))
    assert there is not None and back is not None
    assert (there.deviation, there.tolerance, there.distance) == pytest.approx(
        (back.deviation, back.tolerance, back.distance)
    )


def test_the_speed_before_a_gap_is_not_that_of_the_last_disturbed_poses() -> None:
    """What comes before the camera makes keyframes in a row, and may take the last pose along."""
    graph = KeyframeGraph()
    for k in range(6):
        graph.add(k, at(float(k)), 0, k * 10**9)
    graph.add(6, at(5.3), 0, 5_067_000_000)  # 4.5 m/s
    graph.add(7, np.eye(4), 1, 7_067_000_000)
    gap_motion = graph.gap_motion(6, 7, at(1.0))
    assert gap_motion is not None
    assert gap_motion.tolerance == pytest.approx(0.75 * 2.0 * 1.3 / 1.067, rel=1e-6)
    assert gap_motion.deviation == pytest.approx(abs(1.0 - 1.3 / 1.067), rel=1e-6)


def test_no_prediction_over_a_gap_without_time_or_speed() -> None:
    assert broken(-3.0).gap_motion(3, 6, at(2.0)) is None  # another clock
    graph = KeyframeGraph()
    graph.add(0, at(0.0), 0, 0)
    graph.add(1, at(0.0), 1, 10**9)
    assert graph.gap_motion(0, 1, at(0.5)) is None


def test_submaps_connected_through_a_third_share_its_gaps() -> None:
    graph = broken(1.0)
    graph.add(7, at(0.0), 2, 9 * 10**9)
    graph.add_loop(6, 7, at(0.5))
    gap_motion = graph.gap_motion(5, 7, at(1.5))
    assert gap_motion is not None and gap_motion.deviation == pytest.approx(0.5)


def test_a_loop_that_the_map_refused_leads_nowhere() -> None:
    graph = KeyframeGraph()
    for k in range(20):
        graph.add(k, at(float(k)), k // 10)
    graph.add_loop(2, 12, at(0.1))
    graph.add_loop(5, 19, at(0.3))
    before = graph.around(19)[1]
    graph.take_back_loop(5, 19)
    path = graph.path(5, 19)
    assert path is not None and path.metres == pytest.approx(3.0 + 7.0)
    np.testing.assert_allclose(path.a_T_b, at(-3.0 + 0.1 + 7.0), atol=1e-12)
    assert np.isfinite(before[5]).all() and np.isnan(graph.around(19)[1][5]).all()
    graph.add_loop(3, 13, at(0.2))
    graph.take_back_loop(3, 13)
    assert graph.path(2, 12) is not None


def test_a_saved_map_in_one_piece_is_as_large_as_it_is() -> None:
    """Not as long as all the walks in it: two places of it are as far from each other as they lie."""
    graph = KeyframeGraph()
    for k, x in enumerate((0.0, 50.0, 1.0, 40.0, 2.0)):  # sessions one after another
        graph.add(k, at(x), 0, rigid=True)
    graph.add(5, at(0.0), 1)
    graph.add(6, at(3.0), 1)
    graph.add_loop(0, 5, at(0.0))
    path = graph.path(4, 6)
    assert path is not None and path.metres == pytest.approx(2.0 + 3.0)
    np.testing.assert_allclose(path.a_T_b, at(1.0), atol=1e-12)


def test_nothing_leads_to_a_keyframe_that_was_forgotten() -> None:
    graph = KeyframeGraph()
    for k in range(0, 20, 2):
        graph.add(k, at(float(k)), 0)
    assert graph.path(4, 7) is None and graph.path(4, 8) is not None and graph.path(4, 100) is None
