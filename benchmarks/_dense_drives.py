"""Rows of `benchmarks dense` from drives: rendered ones with exact ranges, real ones by what the next image shows."""

from __future__ import annotations

import hashlib
import resource
import subprocess
import sys
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _dense_open3d import beside
from _figures import commit
from _verdicts import Verdicts
from scipy.spatial import cKDTree

from stereo_sfm.dense.build import CubeIndex, read_depth
from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.inputs import find_input, keyframes
from stereo_sfm.dense.keyframe_depth import KeyframeImages, keyframe_depth, partner, shows_more
from stereo_sfm.dense.surface import extract
from stereo_sfm.dense.views import stereo_view
from stereo_sfm.dense.volume import Seen, contributes, fuse, touched
from stereo_sfm.drivers.sim.kernels import FACING
from stereo_sfm.drivers.sim.render import Renderer
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.maps.floor import floor_of
from stereo_sfm.types import F64, Bool

NEAR_M, CLOSE_M = 2.5, 0.05  # what is measured; of the F-score and of covered surface
SAME_GREY = 10  # levels


@dataclass(frozen=True)
class Truth:
    """What a drive's keyframes saw, a point a centimetre, in the world's frame."""

    points: F64  # (N, 3) metres
    normals: F64  # (N, 3)
    fronts: Bool  # (N,) of shelves, seen from within `NEAR_M`

    def score(self, mesh: F64) -> tuple[float, float, float]:
        """Covered share of fronts, median distance of a mesh's vertices (V, 3) from the surface (m), F-score."""
        away, nearest = cKDTree(self.points).query(mesh)
        plane = np.abs(((mesh - self.points[nearest]) * self.normals[nearest]).sum(1))
        complete = float((cKDTree(mesh).query(self.points[self.fronts])[0] < CLOSE_M).mean())
        right = float((away < CLOSE_M).mean())
        return complete, float(np.median(plane)), 2 * right * complete / (right + complete)


def simulated(
    verdicts: Verdicts, folder: Path, camera: str, metres: float, rays: int, open3d: Path | None = None
) -> None:
    """One drive to a mesh, by the commands a user has; the seed follows from the commit, so that nobody chose it.

    `open3d`: the interpreter that has it; a pinhole drive's depth images are fused by it as well.
    """
    seed = int(hashlib.sha256(f"{commit().rstrip('+')} {camera}".encode()).hexdigest()[:7], 16)
    spec = f"sim:loop?camera={camera}&rays={rays}&seed={seed}&length={metres:g}&rate=15"
    run = folder / f"{camera}_{seed}_{metres:g}_{rays}"
    if not (run / "map" / "map.json").is_file():
        _call("run", spec, "-o", str(run), "--log", "full", "--inline", "-q")
    began, used = time.perf_counter(), _processor_time()
    peak = _call("dense", str(run), "-o", str(run / "surface"), "-q")
    took, used = time.perf_counter() - began, _processor_time() - used
    errors, truth, truth_T_floor = _compared(spec, run)
    mesh = truth.score(se3.transform(truth_T_floor, _vertices(run / "surface" / "cloud.ply")))
    name = f"{camera}, {metres:g} m"
    middle, most = 100 * np.quantile(errors, [0.5, 0.9])
    verdicts.row(f"{name}: depth of fronts, median ≤ 1 %", middle <= 1, f"{middle:.2f} %; seed {seed}")
    verdicts.row(f"{name}: 90 % of it below 3 %", most <= 3, f"{most:.2f} %")
    covered, off, score = mesh
    verdicts.row(f"{name}: fronts covered, ≥ 80 %", covered >= 0.8, f"{100 * covered:.1f} %")
    verdicts.row(f"{name}: mesh off by ≤ 1 cm at the median", off <= 0.01, f"{100 * off:.2f} cm")
    verdicts.row(f"{name}: F-score at 5 cm ≥ 0.9", score >= 0.9, f"{score:.3f}")
    verdicts.row(f"{name}: map to mesh in ≤ 180 s", took <= 180, f"{took:.0f} s, {used:.0f} s of processor time")
    verdicts.row(f"{name}: ≤ 2 GB a process", peak <= 2, f"{peak:.2f} GB")
    if open3d is not None and camera == "pinhole":
        _beside_open3d(verdicts, name, run, peak, (truth, truth_T_floor), open3d)


def _beside_open3d(
    verdicts: Verdicts, name: str, run: Path, peak: float, given: tuple[Truth, F64], python: Path
) -> None:
    """Fusion alone, both from the depth images of the run, in one process and one thread.

    Args:
        peak: GB of the largest process of the whole command. given: the truth, and the pose of the floor in it.
    """
    truth, truth_T_floor = given
    saved, voxel = find_input(run).saved, 0.02
    floor_T_map = se3.inverse(floor_of(saved))
    seen = [
        Seen(depth, floor_T_map @ saved.snapshot.map_T_kf[int(path.stem)], 0)
        for path in sorted((run / "surface" / "depth").glob("*.npz"))
        if (depth := read_depth(path)) is not None
    ]
    other = beside(python, seen, voxel, run)
    places, reach = np.stack([s.floor_T_cam[:3, 3] for s in seen]), np.array([s.reach(voxel) for s in seen])
    fuse((0, 0, 0), seen[:1], voxel)  # compiles
    began, points = time.process_time(), list[F64]()
    for cube in sorted(set[CubeIndex]().union(*(touched(s, voxel) for s in seen))):
        near = [seen[i] for i in np.flatnonzero(contributes(places, reach, cube, voxel))]
        points.append(extract(fuse(cube, near, voxel)).vertices.astype(float) * voxel)
    used = time.process_time() - began
    ours, theirs = (
        truth.score(se3.transform(truth_T_floor, p.astype(float))) for p in (np.concatenate(points), other["vertices"])
    )
    for what, k, text in (("distance of the mesh", 1, "{:.4f} m"), ("F-score", 2, "{:.3f}")):
        holds = ours[k] <= theirs[k] if k == 1 else ours[k] >= theirs[k]
        verdicts.row(
            f"{name}: {what} as good as by Open3D", holds, f"{text.format(ours[k])} and {text.format(theirs[k])}"
        )
    peaks = [float(other[key]) for key in ("seconds", "gigabytes")]
    verdicts.row(f"{name}: fusion as fast as Open3D's", used <= peaks[0], f"{used:.1f} s and {peaks[0]:.1f} s")
    text = f"Open3D {peaks[1]:.2f} GB for the fusion alone"
    verdicts.row(f"{name}: memory of a process ≤ Open3D's", peak <= peaks[1], text)


def _call(*args: str) -> float:
    """Carry out a command; GB of its largest process."""
    command = [sys.executable, str(Path(__file__).with_name("_peak.py")), *args]
    return float(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.split()[-1]) / 1e3


def _processor_time() -> float:
    """Seconds of all processes that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _compared(spec: str, run: Path) -> tuple[F64, Truth, F64]:
    """Relative errors of depths of fronts; what there was to see; pose (4, 4) of the run's floor in that frame."""
    saved = find_input(run).saved
    source: Any = open_source(spec)
    renderer, frames = Renderer(source.world, source.rig), saved.snapshot.frame_ids
    truth_T_map = source.pose(int(frames[0])) @ se3.inverse(saved.snapshot.map_T_kf[0])
    errors, points, normals, fronts = [], [], [], []
    for path in sorted((run / "surface" / "depth").glob("*.npz")):
        pose = source.pose(int(frames[int(path.stem)]))
        view = renderer.view(0, pose)
        front = ((view.ids >> 4) & 7 == FACING) & (view.ids >= 0) & (view.depth < NEAR_M)
        depth = read_depth(path)
        assert depth is not None
        errors.append(_range_errors(depth, source.rig.left, view.depth, front))
        seen = source.rig.left.bearing_grid() * view.depth[..., None]
        normal = np.cross(np.gradient(seen, axis=1), np.gradient(seen, axis=0))
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        some = np.s_[::2, ::2]
        good = np.isfinite(seen[some]).all(-1) & np.isfinite(normal[some]).all(-1)
        points.append(se3.transform(pose, seen[some][good]))
        normals.append(normal[some][good] @ pose[:3, :3].T)
        fronts.append(front[some][good])
    every, which, cells = _thinned(np.concatenate(points))
    near = np.bincount(cells, np.concatenate(fronts)) > 0  # by a keyframe, whatever others see there from afar
    truth = Truth(every, np.concatenate(normals)[which], near)
    return np.concatenate(errors), truth, truth_T_map @ _map_T_floor(run)


def _range_errors(depth: DepthImage, camera: Any, ranges: Any, front: Bool) -> F64:
    """Of the pixels of a depth image that show fronts."""
    uv = camera.project(depth.camera.bearing_grid() @ depth.cam_R_view.T)
    inside = camera.inside(uv, -0.49)
    at = np.rint(np.where(inside[..., None], uv, 0)).astype(int)
    good = inside & front[at[..., 1], at[..., 0]] & np.isfinite(depth.ranges)
    return np.abs(depth.ranges / ranges[at[..., 1], at[..., 0]] - 1)[good]


def _thinned(points: F64) -> tuple[F64, Any, Any]:
    """One point a centimetre cube, its row, and each point's number of cube."""
    cubes = np.floor(points / 0.01).astype(np.int64)
    _, first, cells = np.unique(cubes, axis=0, return_index=True, return_inverse=True)
    return points[first], first, cells.ravel()


def _vertices(path: Path) -> F64:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    rows = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("colour", "u1", 3)]), count)
    return rows["xyz"].astype(float)


def _map_T_floor(run: Path) -> F64:
    import yaml

    return np.array(yaml.safe_load((run / "surface" / "costmap.yaml").read_text())["map_T_floor"]).reshape(4, 4)


def real(verdicts: Verdicts, folder: Path, name: str, spec: str, most: int, sgbm: Any) -> None:
    """Whether depth and pose tell what the next keyframe shows, beside the single pair's depth by OpenCV alone."""
    run = folder / f"real_{name}"
    if not (run / "map" / "map.json").is_file():
        _call("run", spec, "-o", str(run), "--log", "full", "--inline", "-q")
    recent: deque[KeyframeImages] = deque(maxlen=16)
    last: KeyframeImages | None = None
    agree: list[Bool] = []
    for now in keyframes(find_input(run)):
        if last is None or shows_more(last, now):
            if last is not None and last.right is not None:
                agree.append(_agreements(last, partner(recent, last), now, sgbm))
            last = now
        recent.append(now)
        if len(agree) == most:
            break
    ours, base = 100 * np.concatenate(agree, axis=1).mean(axis=1)
    verdicts.row(f"{name}: next image better than by SGBM", ours > base, f"{ours:.1f} %; SGBM {base:.1f} %")


def _agreements(now: KeyframeImages, before: KeyframeImages | None, after: KeyframeImages, sgbm: Any) -> Bool:
    """(2, N) of the pixels that both predict: whether the next image is as bright where each of both puts it."""
    ours = keyframe_depth(now, [before] if before is not None else [])  # not of the image that is predicted
    assert ours is not None and now.right is not None
    scale = 640 / max(now.rig.left.size)
    view = stereo_view(now.rig, min(1.0, scale))
    a, b = view.images(now.left, now.right)
    found = sgbm(a, b, view.disparities)
    found[~view.first.mask] = np.nan
    base = view.ranges(found)[::2, ::2]
    to_next = se3.inverse(after.map_T_cam) @ now.map_T_cam
    rays = ours.camera.bearing_grid() @ ours.cam_R_view.T
    same, seen = [], []
    for ranges in (ours.ranges, base):
        uv = after.rig.left.project(se3.transform(to_next, (rays * ranges[..., None]).reshape(-1, 3)))
        inside = after.rig.left.inside(uv, -0.49)
        at = np.rint(np.where(inside[:, None], uv, 0)).astype(int)
        there = after.left[at[:, 1], at[:, 0]].astype(int)
        same.append(np.abs(there - ours.grey.ravel()) <= SAME_GREY)
        seen.append(inside)
    return np.stack(same)[:, seen[0] & seen[1]]
