"""Calibration from targets: exact corners, noisy corners, rendered boards, real images, and the command."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import load_rig
from stereo_sfm.calib.coverage import coverage, is_new
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.solve import Calibration, align_pairs, calibrate, plane_pose
from stereo_sfm.calib.targets import Detection, Target, read_target
from stereo_sfm.calib.views import find_pairs, gather
from stereo_sfm.cli import main
from stereo_sfm.drivers.sim.boards import Faults, random_views, render_boards
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import U8

CHARUCO = Target("charuco", 8, 8, 0.06, 0.75, "DICT_5X5_100")
RIGS = {"fisheye": ("kb4", 110.0), "distorted": ("pinhole", 45.0)}


def corners(rig: Rig, poses: np.ndarray, noise: float, seed: int = 0) -> tuple[list[Detection], list[Detection]]:
    """What both cameras would detect without images."""
    rng = np.random.default_rng(seed)
    out: tuple[list[Detection], list[Detection]] = ([], [])
    for pose in poses:
        p = se3.transform(pose, CHARUCO.points)
        for side, (camera, q) in enumerate(
            ((rig.left, p), (rig.right, se3.transform(se3.inverse(rig.left_T_right), p)))
        ):
            assert camera is not None
            uv = camera.project(q)
            seen = np.flatnonzero(camera.inside(uv, 3))
            out[side].append(Detection(seen, uv[seen] + noise * rng.standard_normal((len(seen), 2))))
    return out


def solve(rig: Rig, name: str, noise: float, seed: int = 0, views: int = 24) -> Calibration:
    size = CHARUCO.size * np.array([CHARUCO.columns, CHARUCO.rows])
    poses = random_views(rig, size, views, seed, RIGS[name][1])
    left, right = corners(rig, poses, noise, seed)
    return calibrate(left, right, CHARUCO.points, rig.left.size, RIGS[name][0])


def errors(found: Rig, true: Rig) -> tuple[float, float, float, float]:
    """Worst focal error in %, centre in px, baseline in %, rotation in degrees."""
    assert found.right is not None and true.right is not None
    pairs = ((found.left, true.left), (found.right, true.right))
    focal = max(abs(100 * (getattr(a, n) / getattr(b, n) - 1)) for a, b in pairs for n in ("fx", "fy"))
    centre = max(abs(getattr(a, n) - getattr(b, n)) for a, b in pairs for n in ("cx", "cy"))
    turn = se3.so3_log(found.left_T_right[:3, :3].T @ true.left_T_right[:3, :3])
    return focal, centre, abs(100 * (found.baseline / true.baseline - 1)), float(np.rad2deg(np.linalg.norm(turn)))


@pytest.mark.parametrize("name", RIGS)
def test_exact_corners_give_the_exact_rig(name: str) -> None:
    rig = make_rig(name)
    calibration = solve(rig, name, noise=0.0, views=12)
    focal, centre, baseline, turn = errors(calibration.rig, rig)
    assert calibration.rms < 1e-5
    assert focal < 1e-4 and centre < 1e-3 and baseline < 1e-4 and turn < 1e-4


@pytest.mark.parametrize("name", RIGS)
def test_deviations_predict_the_errors_of_the_parameters(name: str) -> None:
    rig = make_rig(name)
    scores: list[np.ndarray] = []
    for seed in range(2):
        calibration = solve(rig, name, noise=0.1, seed=seed, views=14)
        assert calibration.rms == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
        off = [getattr(calibration.rig.left, n) - getattr(rig.left, n) for n in ("fx", "fy", "cx", "cy")]
        off += [*(calibration.rig.left_T_right[:3, 3] - rig.left_T_right[:3, 3])]
        chosen = [*calibration.sigma[:4], *calibration.sigma[-6:-3]]
        scores.append(np.array(off) / chosen)
    spread = float(np.sqrt(np.mean(np.square(scores))))
    assert 0.4 < spread < 1.8


def test_wrong_corners_and_views_are_removed() -> None:
    rig = make_rig("distorted")
    size = CHARUCO.size * np.array([CHARUCO.columns, CHARUCO.rows])
    left, right = corners(rig, random_views(rig, size, 18, 3, 45.0), 0.05, 3)
    rng = np.random.default_rng(9)
    for i in range(0, 18, 3):
        uv = left[i].uv.copy()
        uv[rng.integers(0, len(uv), 3)] += rng.uniform(4, 20, (3, 2))
        left[i] = Detection(left[i].ids, uv)
    right[5] = Detection(right[5].ids, right[5].uv + rng.uniform(-9, 9, right[5].uv.shape))
    calibration = calibrate(left, right, CHARUCO.points, rig.left.size, "pinhole")
    focal, centre, baseline, _ = errors(calibration.rig, rig)
    assert calibration.removed_corners >= 14
    assert focal < 0.15 and centre < 0.5 and baseline < 0.2


def test_plane_pose_beyond_ninety_degrees() -> None:
    pose = se3.exp(np.array([0.9, 0.1, -0.05, 0.2, 1.5, 0.1]))  # partly behind the camera's plane
    points = CHARUCO.points
    p = se3.transform(pose, points)
    assert (p[:, 2] < 0).any()
    found = plane_pose(p / np.linalg.norm(p, axis=1, keepdims=True), points)
    np.testing.assert_allclose(found, pose, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("seed", range(5))
def test_rendered_boards_with_noise_and_blur(name: str, seed: int) -> None:
    rig = make_rig(name)
    pairs, _ = render_boards(rig, CHARUCO, 24, seed, Faults(), RIGS[name][1])
    left, right = ([CHARUCO.detect(p[k]) for p in pairs] for k in range(2))
    found = calibrate(left, right, CHARUCO.points, rig.left.size, RIGS[name][0]).rig
    focal, centre, baseline, _ = errors(found, rig)
    assert focal < 0.1 and centre < 0.3 and baseline < 0.2


def test_rendered_corners_are_where_they_should_be() -> None:
    rig = make_rig("distorted", (320, 200))
    for target in (Target("checkerboard", 9, 6, 0.05), Target("charuco", 5, 5, 0.09, 0.75)):
        pairs, poses = render_boards(rig, target, 4, 1, Faults(0.5, 1.0, 0.2), 25.0)
        found = 0
        for (left, _), pose in zip(pairs, poses, strict=True):
            detection = target.detect(left)
            truth = rig.left.project(se3.transform(pose, target.points))[detection.ids]
            if target.kind == "checkerboard" and len(detection):  # may count from the other end
                truth = min(truth, truth[::-1], key=lambda t: float(np.abs(t - detection.uv).max()))
            if len(detection):
                found += 1
                assert np.median(np.linalg.norm(detection.uv - truth, axis=1)) < 0.2
        assert found >= 2


def test_aprilgrid_layout_is_kalibrs(data_root: Path) -> None:
    target = Target("aprilgrid", 6, 6, 0.088, 0.3)
    assert target.points.shape == (144, 3)
    np.testing.assert_allclose(target.points[4 * 7 + 2, :2], 0.088 * 1.3 + 0.088)  # tag 7: second row, second column
    image = cv2.imread(str(data_root / "calib_aprilgrid_euroc" / "7_0.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    detection = target.detect(np.asarray(image, np.uint8))
    assert len(detection) >= 60
    plane = target.points[detection.ids, :2]
    homography, _ = cv2.findHomography(plane, detection.uv)
    mapped = cv2.perspectiveTransform(plane[None], homography)[0]
    assert np.median(np.linalg.norm(mapped - detection.uv, axis=1)) < 4  # lens distortion only; wrong corners give 50


def test_command_on_a_few_real_images(data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures = tmp_path / "images"
    pictures.mkdir()
    for path in (data_root / "calib_aprilgrid_euroc").glob("*.jpg"):
        if int(path.stem.split("_")[0]) % 3 == 0:
            (pictures / path.name).symlink_to(path)
    folder = str(pictures)
    options = ["--target", "aprilgrid", "--columns", "6", "--rows", "6", "--square", "0.088", "--ratio", "0.3"]
    assert main(["calibrate", folder, *options, "-o", str(tmp_path / "rig.yaml")]) == 0
    captured = capsys.readouterr()
    assert "verdict: " in captured.out and "view 7:" in captured.err
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.baseline == pytest.approx(0.1100, abs=2e-3)  # EuRoC's own calibration: 0.11007
    assert rig.left.fx == pytest.approx(458.65, rel=0.02)
    page = (tmp_path / "rig.html").read_text()
    assert page.count("data:image/") >= 4 and "Epipolar error" in page
    assert main(["calibrate", folder, *options, "-o", str(tmp_path / "rig.yaml")]) == 2
    assert "exists" in capsys.readouterr().err


def test_coverage_names_what_is_missing() -> None:
    grid = np.stack(np.meshgrid(np.linspace(20, 180, 9), np.linspace(20, 140, 6)), -1).reshape(-1, 2)
    one = Detection(np.arange(54), grid)
    seen = coverage([one, Detection(np.zeros(0, np.int64), np.zeros((0, 2)))], (640, 480))
    assert seen.total == 1 and seen.views[0, 0] == 1 and seen.views[4, 4] == 0
    text = " ".join(seen.advice)
    assert "bottom" in text or "more" in text
    assert "tilt" in text and "at least 12" in text
    assert not is_new(one, [one], 640)
    assert is_new(Detection(one.ids, one.uv + 60), [one], 640)


class Lit(Target):
    """Seen in images that are not black."""

    def detect(self, image: U8) -> Detection:
        ids = np.arange(len(self.points) if image.any() else 0)
        return Detection(ids, 100.0 + 1000 * self.points[ids, :2])


@pytest.mark.parametrize("sides", [(1, 0), (0, 1), (1, 1)])
def test_a_board_that_stands_still_is_one_view(sides: tuple[int, int]) -> None:
    left, right = (np.full((48, 64), side, np.uint8) for side in sides)
    kept = gather(iter([(left, right)] * 5), Lit("checkerboard", 9, 6, 0.02), 60, False, lambda *_: None)[2]
    assert len(kept) == 1


def test_reversed_boards_are_turned_round() -> None:
    uv = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), -1).reshape(-1, 2) * 20
    left, right = Detection(np.arange(54), uv), Detection(np.arange(54), uv[::-1].copy())
    np.testing.assert_array_equal(align_pairs([left], [right])[0].uv, uv)


def test_target_files_and_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "april.yaml").write_text(
        "target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3"
    )
    assert read_target(tmp_path / "april.yaml") == Target("aprilgrid", 6, 6, 0.088, 0.3)
    (tmp_path / "c.yaml").write_text("kind: charuco\ncolumns: 5\nrows: 7\nsize: 0.04\ndictionary: DICT_5X5_100")
    assert read_target(tmp_path / "c.yaml").dictionary == "DICT_5X5_100"
    (tmp_path / "bad.yaml").write_text("kind: charuco")
    with pytest.raises(StereoSfmError, match="'columns' is missing"):
        read_target(tmp_path / "bad.yaml")
    with pytest.raises(StereoSfmError, match="unknown target"):
        Target("circles", 3, 3, 0.1)
    empty = [Detection(np.zeros(0, np.int64), np.zeros((0, 2)))] * 5
    with pytest.raises(StereoSfmError, match="not found"):
        calibrate(empty, empty, CHARUCO.points, (640, 480))
    for i in range(3):
        for side in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{side}{i}.png"), np.full((60, 80), 90, np.uint8))
    assert len(find_pairs(tmp_path)) == 3
    options = ["--target", "checkerboard", "--columns", "9", "--rows", "6", "--square", "0.02"]
    assert main(["calibrate", str(tmp_path), *options, "-o", str(tmp_path / "rig.yaml")]) == 2
    assert "no checkerboard" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "right1.png"), np.full((61, 80), 90, np.uint8))
    assert main(["calibrate", str(tmp_path), *options, "-o", str(tmp_path / "rig.yaml")]) == 2
    assert "80x61" in capsys.readouterr().err
