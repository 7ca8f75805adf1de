"""Doors of a floor plan: doorways in walls, and doors that people set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from stereo_sfm.cli import main
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.world import DOORWAY, Layout
from stereo_sfm.drivers.source import open_source
from stereo_sfm.export.doors import PlannedDoor, plan_doors
from stereo_sfm.export.floor_plan import OCCUPIED, UNKNOWN, FloorPlan, make_floor_plan
from stereo_sfm.geometry import se3
from stereo_sfm.maps.labels import Door
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.maps.store import read_about
from tests.export.plans import fill, plan_of
from tests.maps.maps import small_map


def room(gap: tuple[float, float] = (3.0, 4.0)) -> FloorPlan:
    """Two rooms and a wall of 0.2 m along x between them, seen from both sides in patches, with a gap in it."""
    plan = plan_of(10.0, 8.0, (-1.0, -2.0))
    for x0, x1 in ((-1.0, gap[0]), (gap[1], 9.0)):
        fill(plan, x0, 1.9, x1, 2.1, UNKNOWN)
        for x in np.arange(x0, x1, 0.3):  # every third cell of both faces
            for y in (1.9, 2.05):
                fill(plan, x, y, x + 0.1, y + 0.05, OCCUPIED)
    return plan


def turned(plan: FloorPlan) -> FloorPlan:
    """The same with x and y exchanged."""
    rising = plan.image[::-1]
    image = np.ascontiguousarray(rising.T[::-1])
    return FloorPlan(image, plan.resolution, (plan.origin[1], plan.origin[0]), plan.map_T_floor)


def ends(door: PlannedDoor) -> tuple[float, ...]:
    return (*door.door.start, *door.door.end)


def test_a_doorway_is_found_where_it_is_in_walls_along_both_axes() -> None:
    (door,) = plan_doors(room())
    assert ends(door) == pytest.approx((3.0, 2.0, 4.0, 2.0), abs=0.06)
    assert door.door.length == pytest.approx(1.0, abs=0.06) and door.seen_open and door.door.name == ""
    (door,) = plan_doors(turned(room()))
    assert ends(door) == pytest.approx((2.0, 3.0, 2.0, 4.0), abs=0.06)


@pytest.mark.parametrize("gap", [(3.0, 3.5), (3.0, 5.0)])
def test_slits_and_wide_passages_are_no_doorways(gap: tuple[float, float]) -> None:
    assert plan_doors(room(gap)) == []


def test_what_is_no_wall_has_no_doorway() -> None:
    niche = room()
    fill(niche, 3.0, 2.4, 4.0, 2.6, OCCUPIED)  # the wall behind it
    aisle = plan_of(10.0, 8.0, (0.0, 0.0))  # between two gondolas
    for x0, x1 in ((2.0, 4.0), (5.2, 7.2)):
        fill(aisle, x0, 2.0, x1, 6.0, OCCUPIED)
    unseen = room()
    fill(unseen, 3.0, 2.1, 4.0, 6.0, UNKNOWN)  # nobody looked through
    pillars = plan_of(10.0, 8.0, (0.0, 0.0))
    for x in (3.0, 4.4):
        fill(pillars, x, 3.0, x + 0.4, 3.4, OCCUPIED)
    for plan in (niche, aisle, unseen, pillars):
        assert plan_doors(plan) == []


def test_a_door_set_by_hand_names_the_doorway_near_it_or_stands_for_itself() -> None:
    doors = [Door("staff", (8.9, 4.0), (8.9, 5.0)), Door("stockroom", (3.1, 2.2), (4.2, 2.2))]
    found = plan_doors(room(), doors)
    assert [(d.door.name, d.seen_open) for d in found] == [("stockroom", True), ("staff", False)]
    assert ends(found[0]) == pytest.approx((3.0, 2.0, 4.0, 2.0), abs=0.06)
    assert found[1].door == doors[0] and found[1].door.length == pytest.approx(1.0)


def test_doors_are_set_written_and_removed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    save_map(small_map()[1], store)
    assert main(["map", "label", str(store), "staff", "1,0", "1,0.9", "--door"]) == 0
    assert main(["map", "label", str(store), "aisle 1", "0,0", "5,0"]) == 0
    about = read_about(store)
    assert about.doors == (Door("staff", (1.0, 0.0), (1.0, 0.9)),) and len(about.aisles) == 1
    assert main(["map", "plan", str(store), "--resolution", "0.1"]) == 0
    assert "doors in doors.yaml" in capsys.readouterr().out
    rows = yaml.safe_load((store / "doors.yaml").read_text())
    assert rows[-1] == {"label": "staff", "start": [1.0, 0.0], "end": [1.0, 0.9], "width": 0.9, "seen_open": False}
    assert main(["map", "label", str(store), "staff", "--remove"]) == 0
    assert not read_about(store).doors and read_about(store).aisles


@pytest.mark.slow
def test_the_doorway_of_a_driven_store(tmp_path: Path) -> None:
    run, spec = tmp_path / "run", "sim:stockroom?size=424x400&rate=10"
    assert main(["run", spec, "--out", str(run), "--quiet"]) == 0
    s = load_map(run / "map").snapshot
    plan = make_floor_plan(s)
    (door,) = plan_doors(plan)
    assert door.door.length == pytest.approx(DOORWAY[0], abs=0.15)
    layout = SCENES["stockroom"].layout
    assert isinstance(layout, Layout)
    with open_source(spec) as source:
        truth = source.ground_truth
    assert truth is not None
    at = plan.map_T_floor @ np.array([*door.door.middle, 0.0, 1.0])
    row = int(np.searchsorted(truth.stamp_ns, s.stamp_ns[0]))
    world_T_map = truth.poses[row] @ se3.inverse(s.map_T_kf[0])
    assert (world_T_map @ at)[:2] == pytest.approx(np.mean(layout.doorway, axis=0), abs=0.1)
