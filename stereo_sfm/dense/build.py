"""From keyframes to a surface: depth images and cubes as files, each made again only if its input moved.

Every file carries the checksum of what it was made of, and is renamed into place when it is complete: a run that was
killed goes on where it was, and after a loop or `map update` only the cubes of keyframes that moved are fused again.
"""

from __future__ import annotations

import hashlib
import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from stereo_sfm.arrays import read_arrays, write_arrays
from stereo_sfm.calib.formats.native import rig_to_text
from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.inputs import DenseInput, keyframes
from stereo_sfm.dense.keyframe_depth import KeyframeImages, keyframe_depth, with_partners
from stereo_sfm.dense.surface import LEAST_VIEWS, Surface, extract
from stereo_sfm.dense.volume import CACHED, SIDE, Seen, contributes, fuse, touched
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import MODELS
from stereo_sfm.input_file import read_bytes
from stereo_sfm.maps.floor import HIGH, LOW
from stereo_sfm.types import F64, U8, Bool

T = TypeVar("T")
R = TypeVar("R")
VERSION = "7"  # of the files: grows when the same input gives other bits
PLACE = 1e-5  # metres, radians: keyframes that moved by less show the same
CubeIndex = tuple[int, int, int]
Bands = tuple[tuple[float, float], ...]  # of heights above the floor, metres
ROBOT: Bands = ((LOW, HIGH),)
Report = Callable[[str, int, int], None]  # what, done, of


@dataclass(frozen=True, eq=False)
class KeptDepth:
    """A depth image on disk and what is known of it without reading it."""

    path: Path
    key: str  # checksum of what it was made of
    floor_T_cam: F64
    session: int
    reach: float  # metres

    def place_key(self) -> str:
        """Changes with the image, its session or its pose, as far as a map that is saved again does not."""
        pose = np.rint(self.floor_T_cam / PLACE).astype(np.int64)
        return f"{self.key}{self.session}" + hashlib.sha256(pose.tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class Volume:
    """Cubes on disk, of which no more than one is read at a time."""

    folder: Path
    indices: list[CubeIndex]  # in order
    voxel: float  # metres
    map_T_floor: F64  # (4, 4)
    base_T_left: F64  # (4, 4) of the newest session's rig

    def surfaces(self) -> Iterator[Surface]:
        """Of each cube that has one."""
        for _, data in self._read("cells", "vertices", "grey", "quads"):
            if len(data["quads"]):
                yield Surface(**data)

    def columns(self, bands: Bands) -> Iterator[tuple[CubeIndex, Bool, Bool]]:
        """Each cube's index, its columns (bands, 64, 64) along x, y with a surface in a band, and those seen free."""
        for index, data in self._read("occupied", "free"):
            height = (index[2] * SIDE + np.arange(float(SIDE))) * self.voxel
            occupied, free = (_columns(np.unpackbits(data[name]), height, bands) for name in ("occupied", "free"))
            yield index, occupied, free

    def _read(self, *names: str) -> Iterator[tuple[CubeIndex, dict[str, Any]]]:
        for index in self.indices:
            path = self.folder / _cube_name(index)
            data = _read(path, None, names)
            if data is None:
                raise _lost(path)
            yield index, data


def build(given: DenseInput, folder: Path, voxel: float, jobs: int, report: Report = lambda *_: None) -> Volume:
    """Make or go on with the depth images and the cubes of a folder.

    Args:
        given: the map and its images. folder: for the files; may hold those of an earlier run.
        voxel: metres. jobs: processes; the bits do not depend on them. report: called after each step.

    Raises:
        StereoSfmError: no keyframe has depth, or none that is precise enough for such voxels.
    """
    map_T_floor = given.map_T_floor
    for name in ("depth", "cubes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with _Workers(jobs) as workers:
        kept, cubes = _depths(given, folder / "depth", voxel, map_T_floor, workers, report)
        if not kept:
            raise StereoSfmError("no keyframe has depth: one camera needs keyframes 10 to 40 cm apart")
        if not cubes:
            raise StereoSfmError(f"no depth is precise enough for voxels of {voxel:g} m: choose a larger --voxel")
        places, reach = np.stack([k.floor_T_cam[:3, 3] for k in kept]), np.array([k.reach for k in kept])
        seen_by = ([kept[i] for i in np.flatnonzero(contributes(places, reach, c, voxel))] for c in cubes)
        tasks = ((c, views, folder / "cubes", voxel) for c, views in zip(cubes, seen_by, strict=True))
        for number, _ in enumerate(workers.map(_cube, tasks), 1):
            report("cubes", number, len(cubes))
    _remove_others(folder / "depth", {k.path.name for k in kept})
    _remove_others(folder / "cubes", {_cube_name(c) for c in cubes})
    return Volume(folder / "cubes", cubes, voxel, map_T_floor, given.saved.rig.base_T_left)


class _Workers:
    """Results in the order of the tasks, from processes or from this one; bounded number of tasks in flight."""

    def __init__(self, jobs: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_one_thread) if jobs > 1 else None
        self._ahead = 2 * jobs

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=kind is not None)

    def map(self, function: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
        if self._pool is None:
            yield from map(function, tasks)
            return
        waiting: deque[Future[R]] = deque()
        for task in tasks:
            waiting.append(self._pool.submit(function, task))
            if len(waiting) >= self._ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _one_thread() -> None:
    import cv2

    cv2.setNumThreads(1)


# -- depth images ---------------------------------------------------------------------------------------------------


def _depths(
    given: DenseInput, folder: Path, voxel: float, map_T_floor: F64, workers: _Workers, report: Report
) -> tuple[list[KeptDepth], list[CubeIndex]]:
    """The depth images, and the cubes in which they have surfaces, in order."""
    floor_T_map, sessions, count = se3.inverse(map_T_floor), given.saved.sessions, len(given.saved)

    def tasks() -> Iterator[Any]:
        for found in with_partners(keyframes(given), sessions):
            if found is None:
                yield None
                continue
            now, others = found
            yield now, others, folder, voxel, floor_T_map @ now.map_T_cam, int(sessions[now.number])

    kept, cubes = list[KeptDepth](), set[CubeIndex]()
    for number, result in enumerate(workers.map(_depth, tasks()), 1):
        if result is not None:
            kept.append(result[0])
            cubes |= result[1]
        report("depth images", number, count)
    return kept, sorted(cubes)


def _depth(task: Any) -> tuple[KeptDepth, set[CubeIndex]] | None:
    if task is None:  # a keyframe that shows what another showed
        return None
    now, others, folder, voxel, floor_T_cam, session = task
    path, key = folder / f"{now.number:06d}.npz", _depth_key(now, others)
    found = read_depth(path, key)
    if found is None:
        found = keyframe_depth(now, others)
        if found is None:
            return None
        _write(path, key, _depth_columns(found))
    seen = Seen(found, floor_T_cam, session)
    return KeptDepth(path, key, floor_T_cam, session, seen.reach(voxel)), touched(seen, voxel)


def _depth_key(now: KeyframeImages, others: list[KeyframeImages]) -> str:
    """Of the images, the cameras and the motions between, to a hundredth of a millimetre: less moves no disparity."""
    digest = hashlib.sha256(VERSION.encode())
    for part in (now.left, now.right, *(other.left for other in others)):
        digest.update(b"-" if part is None else part.tobytes())
    digest.update(rig_to_text(now.rig).encode())
    for other in others:
        motion = se3.inverse(now.map_T_cam) @ other.map_T_cam
        digest.update(np.rint(motion / PLACE).astype(np.int64).tobytes())
    return digest.hexdigest()


def _depth_columns(depth: DepthImage) -> dict[str, Any]:
    c = depth.camera
    return {
        "ranges": depth.ranges, "sigmas": depth.sigmas, "grey": depth.grey, "cam_R_view": depth.cam_R_view,
        "model": np.array(c.model), "size": np.array(c.size), "camera": np.array([c.fx, c.fy, c.cx, c.cy]),
    }  # fmt: skip


def read_depth(path: Path, key: str | None = None) -> DepthImage | None:
    """A stored depth image; None where there is none, or not of `key`."""
    data = _read(path, key)
    if data is None:
        return None
    width, height = data["size"].tolist()
    camera = MODELS[str(data["model"])](width, height, *data["camera"].tolist())
    return DepthImage(camera, data["cam_R_view"], data["ranges"], data["sigmas"], data["grey"])


def some_depths(folder: Path, count: int) -> list[DepthImage]:
    """Depth images of a reconstruction, evenly spread over its keyframes. Args: folder, of `build`."""
    paths = sorted((folder / "depth").glob("*.npz"))
    found = [read_depth(paths[(2 * k + 1) * len(paths) // (2 * count)]) for k in range(min(count, len(paths)))]
    return [depth for depth in found if depth is not None]


@lru_cache(CACHED)
def _cached_depth(path: Path, key: str) -> DepthImage:
    found = read_depth(path, key)
    if found is None:
        raise _lost(path)
    return found


# -- cubes ----------------------------------------------------------------------------------------------------------


def _cube_name(index: CubeIndex) -> str:
    return "_".join(map(str, index)) + ".npz"


def _cube(task: Any) -> None:
    index, kept, folder, voxel = task
    path = folder / _cube_name(index)
    key = hashlib.sha256("".join([VERSION, f"{voxel!r}", *(k.place_key() for k in kept)]).encode()).hexdigest()
    if _read(path, key) is None:
        newest_first = sorted(kept, key=lambda k: -k.session)
        images = (Seen(_cached_depth(k.path, k.key), k.floor_T_cam, k.session) for k in newest_first)
        cube = fuse(index, images, voxel)
        surface = extract(cube)
        own = np.s_[1 : SIDE + 1, 1 : SIDE + 1, 1 : SIDE + 1]
        seen = cube.views[own] >= LEAST_VIEWS
        columns = {
            "cells": surface.cells, "vertices": surface.vertices, "grey": surface.grey, "quads": surface.quads,
            "occupied": np.packbits(seen & (np.abs(cube.distance[own]) < voxel)),
            "free": np.packbits(seen & (cube.distance[own] > voxel)),
            "distance": cube.distance[own].astype(np.float16), "weight": cube.weight[own],
        }  # fmt: skip
        _write(path, key, columns)


def _columns(voxels: U8, height: F64, bands: Bands) -> Bool:
    """(bands, 64, 64) whether a voxel of a column is set in each band. Args: (64 ** 3,) bits, (64,) metres."""
    cube = voxels.reshape(SIDE, SIDE, SIDE).astype(bool)
    return np.stack([cube[:, :, (height > low) & (height < high)].any(axis=2) for low, high in bands])


def _remove_others(folder: Path, names: set[str]) -> None:
    """Files of keyframes and cubes in which nothing is any more."""
    for path in sorted(folder.glob("*.npz")):
        if path.name not in names:
            path.unlink()


# -- files ----------------------------------------------------------------------------------------------------------


def _lost(path: Path) -> StereoSfmError:
    return StereoSfmError(f"{path} was removed or changed while it was used: run again")


def _write(path: Path, key: str, columns: dict[str, Any]) -> None:
    """Complete or not at all."""
    part = path.with_suffix(".part")
    try:
        write_arrays(part, {"key": np.array(key), **columns})
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _read(path: Path, key: str | None, names: Sequence[str] = ()) -> dict[str, Any] | None:
    """The columns of a file; None where there is none, it is damaged, or it was made of something else.

    `key`: of what it should be made of; None: of anything. `names`: of columns, if not all.
    """
    try:
        data = read_arrays(read_bytes(path), names)
        return data if key is None or str(data["key"]) == key else None
    except (OSError, ValueError, KeyError):
        return None
