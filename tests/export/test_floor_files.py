"""Keep-out zones drawn on a floor plan, shelf fronts as lines, and the files that map_server reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN
from stereo_sfm.export.keep_out import ABOUT, DRAWING, covering, read_zones, write_zones
from stereo_sfm.export.shelf_fronts import shelf_fronts
from stereo_sfm.geometry import se3
from stereo_sfm.maps.labels import Aisle
from stereo_sfm.maps.saved_map import save_map
from tests.export.plans import fill, plan_of
from tests.maps.maps import small_map
from tests.synthetic import pinhole_rig


def test_zones_drawn_by_hand_stay_where_they_are_when_the_plan_grows(tmp_path: Path) -> None:
    plan = plan_of(6.0, 4.0, (-1.0, -2.0))
    write_zones(tmp_path, plan, read_zones(tmp_path, plan), np.eye(4))
    picture: Any = cv2.imread(str(tmp_path / DRAWING))
    assert picture.shape == (80, 120, 3)
    # 2 to 3 m along x, 0.5 to 1.5 m along y: as a person draws, in a red of their own
    picture[(80 - 70) : (80 - 50), 60:80] = (10, 0, 255)
    cv2.imwrite(str(tmp_path / DRAWING), picture)
    zones = read_zones(tmp_path, plan)
    assert zones.sum() == 20 * 20
    for grown in (plan_of(9.0, 8.0, (-2.5, -4.0)), plan_of(9.0, 8.0, (-2.5, -4.0), 0.1)):
        seen = read_zones(tmp_path, grown)
        rows, columns = np.nonzero(seen[::-1])
        xs, ys = (grown.origin[0] + columns * grown.resolution), (grown.origin[1] + rows * grown.resolution)
        assert (xs.min(), ys.min()) == pytest.approx((2.0, 0.5), abs=0.01)
        assert (xs.max() + grown.resolution, ys.max() + grown.resolution) == pytest.approx((3.0, 1.5), abs=0.01)
    grown = plan_of(9.0, 8.0, (-2.5, -4.0))
    write_zones(tmp_path, grown, read_zones(tmp_path, grown), np.eye(4))
    assert (read_zones(tmp_path, plan) == zones).all()
    mask = cv2.imread(str(tmp_path / "keepout_mask.pgm"), cv2.IMREAD_GRAYSCALE)
    about = yaml.safe_load((tmp_path / "keepout_mask.yaml").read_text())
    assert mask is not None and (mask == OCCUPIED).sum() == 400 and set(np.unique(mask)) == {FREE, OCCUPIED}
    assert about["origin"] == [-2.5, -4.0, 0.0] and about["image"] == "keepout_mask.pgm"


def test_zones_beyond_a_plan_that_shrank_stay(tmp_path: Path) -> None:
    plan, smaller = plan_of(6.0, 4.0, (-1.0, -2.0)), plan_of(2.0, 2.0, (-1.0, -2.0))
    zones = np.zeros(plan.image.shape, bool)
    zones[5:10, 100:110] = True  # at the upper right
    write_zones(tmp_path, plan, zones, np.eye(4))
    covered = covering(smaller, tmp_path)
    assert covered.origin == smaller.origin and (covered.image[-40:, :40] == smaller.image).all()
    write_zones(tmp_path, covered, read_zones(tmp_path, covered), np.eye(4))
    assert (read_zones(tmp_path, plan) == zones).all()


def test_the_mask_lies_where_robots_think_they_are(tmp_path: Path) -> None:
    """Nav2 loads it beside the service's poses: the first robot's pose is its origin, its axes those of the robot."""
    base_T_left = pinhole_rig().base_T_left
    floor = se3.exp(np.array([3.0, -1.1, -0.4, 0.0, 0.0, 0.7]))  # in the robot's map
    plan = replace(plan_of(6.0, 4.0, (-1.0, -2.0)), map_T_floor=se3.inverse(base_T_left) @ floor)
    zones = np.zeros(plan.image.shape, bool)
    zones[40:50, 60:70] = True
    write_zones(tmp_path, plan, zones, base_T_left)
    about = yaml.safe_load((tmp_path / "keepout_mask.yaml").read_text())
    mask = cv2.imread(str(tmp_path / "keepout_mask.pgm"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    rows, columns = np.nonzero(mask[::-1] == OCCUPIED)
    seen = np.array(about["origin"][:2]) + (np.array([columns.mean(), rows.mean()]) + 0.5) * about["resolution"]
    rows, columns = np.nonzero(zones[::-1])
    middle = np.array(plan.origin) + (np.array([columns.mean(), rows.mean()]) + 0.5) * plan.resolution
    there = se3.transform(floor, np.array([[*middle, 0.0]]))[0]
    assert np.linalg.norm(seen - there[:2]) < plan.resolution


def test_a_drawing_of_unknown_place_is_refused(tmp_path: Path) -> None:
    plan = plan_of(2.0, 2.0, (0.0, 0.0))
    write_zones(tmp_path, plan, np.zeros(plan.image.shape, bool), np.eye(4))
    (tmp_path / ABOUT).unlink()
    with pytest.raises(StereoSfmError, match="does not say where"):
        read_zones(tmp_path, plan)


def test_shelf_fronts_are_lines_with_the_aisles_names() -> None:
    plan = plan_of(12.0, 8.0, (-1.0, -1.0))
    fill(plan, 1.0, 2.0, 9.0, 3.0, OCCUPIED)  # a gondola between two aisles
    fill(plan, 1.0, 2.3, 9.0, 2.7, UNKNOWN)  # whose inside nobody sees
    fill(plan, 4.0, 2.9, 4.3, 3.0, FREE)  # with a gap in its front
    fill(plan, 9.5, 5.0, 9.8, 5.3, OCCUPIED)  # a pillar
    aisles = [Aisle("aisle 1", (0.0, 1.0), (10.0, 1.0)), Aisle("aisle 2", (10.0, 4.5), (0.0, 4.5))]
    fronts = shelf_fronts(plan, aisles)
    long = {f.faces: f for f in fronts if abs(f.end[0] - f.start[0]) > 2}
    assert set(long) == {(0, 1), (0, -1)}
    assert [f.label for f in (long[0, -1], long[0, 1])] == ["aisle 1, left", "aisle 2, left"]
    for faces, y in (((0, -1), 2.0), ((0, 1), 3.0)):
        assert long[faces].start == pytest.approx((1.0, y), abs=0.06)
        assert long[faces].end == pytest.approx((9.0, y), abs=0.06)
    assert not [f for f in fronts if f.start[0] > 9.2]


def test_the_plan_of_a_store_is_written_for_map_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    save_map(small_map()[1], store)
    assert main(["map", "plan", str(store), "--resolution", "0.1"]) == 0
    assert "shelf fronts" in capsys.readouterr().out
    about = yaml.safe_load((store / "floor_plan.yaml").read_text())
    raw = (store / about["image"]).read_bytes()
    assert raw.startswith(b"P5") and about["resolution"] == 0.1 and len(about["origin"]) == 3
    image = cv2.imread(str(store / about["image"]), cv2.IMREAD_GRAYSCALE)
    assert image is not None and {FREE, OCCUPIED} <= set(np.unique(image).tolist())
    picture: Any = cv2.imread(str(store / DRAWING))
    picture[5:15, 5:15] = (0, 0, 255)
    cv2.imwrite(str(store / DRAWING), picture)
    assert main(["map", "plan", str(store), "--resolution", "0.1"]) == 0
    assert "1.0 m2 of keep-out" in capsys.readouterr().out
