"""The floor plan of a store for robots, written into its folder: plan, keep-out zones, shelf fronts, doors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from stereo_sfm.export.doors import plan_doors
from stereo_sfm.export.floor_plan import make_floor_plan, write_floor_plan
from stereo_sfm.export.keep_out import covering, read_zones, write_zones
from stereo_sfm.export.shelf_fronts import shelf_fronts
from stereo_sfm.maps.store import load_current, lock_about, read_about, write_about

PLAN, FRONTS, DOORS = "floor_plan.pgm", "shelf_fronts.yaml", "doors.yaml"
RESOLUTION_M = 0.05  # a pixel


def write_store_plan(store: Path, resolution: float = RESOLUTION_M) -> str:
    """Write the files; returns a line about them. Args: resolution, metres a pixel."""
    with lock_about(store):
        saved = load_current(store)
        about = read_about(store, saved)
        write_about(store, about)  # the frame of the drawing
        plan = covering(make_floor_plan(saved.snapshot, resolution, about.map_T_floor), store)
        zones = read_zones(store, plan)
        write_floor_plan(plan, store / PLAN)
        write_zones(store, plan, zones, saved.rig.base_T_left)
        fronts = shelf_fronts(plan, about.aisles)
        doors = plan_doors(plan, about.doors)
        _write_rows(
            store / FRONTS,
            [{"label": f.label, "start": list(f.start), "end": list(f.end), "faces": list(f.faces)} for f in fronts],
        )
        _write_rows(
            store / DOORS,
            [
                {"label": d.door.name, "start": list(d.door.start), "end": list(d.door.end)}
                | {"width": round(d.door.length, 3), "seen_open": d.seen_open}
                for d in doors
            ],
        )
    square = float(zones.sum()) * resolution**2
    return (
        f"{store / PLAN}, {len(fronts)} shelf fronts in {FRONTS}, {len(doors)} doors in {DOORS},"
        f" {square:.1f} m2 of keep-out zones in keepout.png"
    )


def _write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    path.write_text(yaml.safe_dump([dict(row) for row in rows], sort_keys=False, allow_unicode=True), encoding="utf-8")
