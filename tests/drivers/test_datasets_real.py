"""The real sequences: their documented properties, and geometry that requires correct conventions."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, StereoImage

# folder: frames, size, baseline (m), lens, path of the ground truth (m) where there is one
FACTS = {
    "kitti": (120, (1241, 376), 0.5372, "pinhole", 91.97),
    "euroc_mh01": (180, (752, 480), 0.1101, "radtan", 2.87),
    "tum_vi_room1": (4, (1024, 1024), 0.1010, "kannala_brandt", 0.0247),
    "t265_office": (3, (848, 800), 0.064, "kannala_brandt", None),
    "rgbd_dataset_freiburg1_xyz": (40, (640, 480), 0.08, "radtan", 2.01),
}


@pytest.mark.parametrize("folder", FACTS)
def test_facts(folder: str, data_root: Path) -> None:
    frames, size, baseline, model, path = FACTS[folder]
    with open_source(data_root / folder) as source:
        images = list(source)
        assert len(images) == frames == source.frame_count
        assert source.rig.left.size == size and source.rig.left.model == model
        assert source.rig.baseline == pytest.approx(baseline, abs=1e-4)
        assert (source.ground_truth is None) == (path is None)
        if source.ground_truth is not None:
            assert source.ground_truth.length == pytest.approx(path, rel=0.01)
            assert source.ground_truth.stamp_ns[0] <= images[0].stamp_ns
        assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(images))
        assert all(i.left.mean() > 20 for i in images)


def matches(left: StereoImage, a: str, right: StereoImage, b: str) -> tuple[F64, F64]:
    """(N, 2) px in image `a` of `left` and image `b` of `right`."""
    orb = cv2.ORB_create(2000)
    keys_a, desc_a = orb.detectAndCompute(getattr(left, a), None)
    keys_b, desc_b = orb.detectAndCompute(getattr(right, b), None)
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(desc_a, desc_b)
    good = [m for m in found if m.distance < 32]
    return np.array([keys_a[m.queryIdx].pt for m in good]), np.array([keys_b[m.trainIdx].pt for m in good])


def epipolar_angles(source: Source, image: StereoImage) -> F64:
    """(N,) radians between each right bearing and the epipolar plane of its left one."""
    rig = source.rig
    assert rig.right is not None
    uv_left, uv_right = matches(image, "left", image, "right")
    left, right = rig.left.unproject(uv_left), rig.right.unproject(uv_right)
    normal = np.cross(rig.left_T_right[:3, 3], left)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.abs(np.arcsin(np.einsum("ni,ni->n", normal, right @ rig.left_T_right[:3, :3].T)))


@pytest.mark.parametrize("folder", ["kitti", "euroc_mh01", "tum_vi_room1", "t265_office"])
def test_matches_lie_in_the_epipolar_planes(folder: str, data_root: Path) -> None:
    with open_source(data_root / folder) as source:
        angles = epipolar_angles(source, next(iter(source)))
        pixels = angles * source.rig.left.fx
        assert len(pixels) > 50
        assert np.nanmedian(pixels) < 1.0


def test_ground_truth_of_euroc_explains_the_motion_in_the_image(data_root: Path) -> None:
    """Points triangulated in one frame reproject into a later one by world_T_cam0: off by pixels with a wrong T_BS."""
    from stereo_sfm.eval.associate import poses_at

    with open_source(data_root / "euroc_mh01") as source:
        images = list(source)
        first, later = images[0], images[20]
        assert source.ground_truth is not None and source.rig.right is not None
        poses, kept = poses_at(source.ground_truth, np.array([first.stamp_ns, later.stamp_ns], np.int64))
        assert len(kept) == 2
        uv_left, uv_right = matches(first, "left", first, "right")
        a = source.rig.left.unproject(uv_left)
        b = source.rig.right.unproject(uv_right) @ source.rig.left_T_right[:3, :3].T
        t = source.rig.left_T_right[:3, 3]
        # a s - b r = t in the least-squares sense, for the depth s along a.
        ab = np.einsum("ni,ni->n", a, b)
        s = (a @ t - ab * (b @ t)) / (1 - ab**2)
        ok = (s > 0.5) & (s < 10)
        points = a[ok] * s[ok, None]
        seen = source.rig.left.project(se3.transform(se3.inverse(poses[1]) @ poses[0], points))
        uv_first, uv_later = matches(first, "left", later, "left")
        errors: list[float] = []
        for uv, prediction in zip(uv_left[ok], seen, strict=True):
            hit = np.flatnonzero((np.abs(uv_first - uv) < 0.5).all(1))
            if len(hit):
                errors.append(float(np.linalg.norm(uv_later[hit[0]] - prediction)))
        assert len(errors) > 20
        assert np.median(errors) < 2.5
