"""A saved map: a versioned folder of `map.json`, `cameras.yaml`, `rig.yaml` and four npz files, without images.

Equal maps give equal bytes. An invalid folder gives a one-line error.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.arrays import read_arrays, write_arrays
from stereo_sfm.calib.formats.native import read_native, rig_to_text, write_native
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.cameras import MapCamera, cameras_text, difference, read_cameras, unified
from stereo_sfm.maps.columns import COLUMNS, KEYS, check_columns
from stereo_sfm.maps.header import COUNTS, checksum, damaged, read_header, write_header
from stereo_sfm.maps.replace_folder import replaced_folder
from stereo_sfm.types import F64, I64, RIG_TERMS, MapUpdate, Trajectory

log = logging.getLogger("stereo_sfm")

RIG, CAMERAS = "rig.yaml", "cameras.yaml"
_FILES = {table: [n for n, c in COLUMNS.items() if c.table == table] for table in KEYS}
_LATER = "corner_side", "down", "down_sigma"  # columns that files of older versions lack: zeros


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map with everything needed to use it again."""

    snapshot: MapSnapshot  # keyframes, points and observations
    cameras: Mapping[int, MapCamera]  # of each session, by its number
    vocabulary_id: str  # of the visual words that its keyframes are found by
    sessions: I64  # (K,) session of each keyframe: 0, 1, ...

    @staticmethod
    def of_session(snapshot: MapSnapshot, camera: MapCamera, vocabulary_id: str) -> SavedMap:
        """The map of one session."""
        return SavedMap(snapshot, {0: camera}, vocabulary_id, np.zeros(len(snapshot.kf_ids), np.int64))

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.snapshot.kf_ids)

    @property
    def rig(self) -> Rig:
        """The rig of the newest session."""
        return self.cameras[int(self.sessions.max())].rig

    def correction_of(self, rig: Rig) -> F64:
        """(8,) terms that the newest session of a camera found of its calibration; zeros if there is none."""
        text = rig_to_text(rig)
        found = [self.cameras[k].terms for k in self.session_ids if self.cameras[k].text == text]
        return found[-1] if found else np.zeros(RIG_TERMS)

    def keyframe_rigs(self, first: Sequence[Rig] = ()) -> list[Rig]:
        """The rig of each keyframe, one object for equal ones; of those equal to one of `first`, that object."""
        used = self.session_ids
        rigs = unified([*first, *(self.cameras[k].rig for k in used)])[len(first) :]
        of = dict(zip(used, rigs, strict=True))
        return [of[k] for k in self.sessions.tolist()]

    @property
    def session_ids(self) -> list[int]:
        """The sessions that have keyframes, ascending."""
        return np.unique(self.sessions).tolist()


def map_files() -> frozenset[str]:
    """The names of the files of a map."""
    return frozenset({"map.json", RIG, CAMERAS, *(f"{name}.npz" for name in _FILES)})


def save_map(
    saved: SavedMap,
    folder: Path | str,
    beside: Mapping[str, bytes] | None = None,
    compress: bool = True,
    synced: bool = True,
) -> None:
    """Write a map folder atomically; other files in it stay.

    Args:
        saved: the map. folder: where. beside: further files of the folder, by name.
        compress: False where the processor is needed for more than the disk. synced: survives a loss of power.

    Raises:
        StereoSfmError: the map is empty.
    """
    if not len(saved) or not len(saved.snapshot.points):
        raise StereoSfmError("the map is empty: nothing to save")
    folder = Path(folder).expanduser()
    beside = beside or {}
    with replaced_folder(folder, map_files() | beside.keys(), synced) as draft:
        checksums: dict[str, str] = {}
        for name, columns in _FILES.items():
            path = draft / f"{name}.npz"
            write_arrays(path, {c: _column(saved, c) for c in columns}, compress)
            checksums[name] = checksum(read_bytes(path))
        write_native(saved.rig, draft / RIG)
        (draft / CAMERAS).write_text(cameras_text(saved.cameras, saved.session_ids), encoding="utf-8")
        checksums |= {"rig": checksum(read_bytes(draft / RIG)), "cameras": checksum(read_bytes(draft / CAMERAS))}
        write_header(draft, _counts(saved), saved.vocabulary_id, checksums)
        for name, data in beside.items():
            (draft / name).write_bytes(data)


def _counts(saved: SavedMap) -> dict[str, int]:
    """The row counts in map.json."""
    s = saved.snapshot
    sessions = int(saved.sessions.max(initial=-1)) + 1
    return {"keyframes": len(s.kf_ids), "points": len(s.pt_ids), "observations": len(s.obs_kf), "sessions": sessions}


def _column(saved: SavedMap, name: str) -> Any:
    """Pixels as float32, as stored in the map."""
    value = saved.sessions if name == "sessions" else getattr(saved.snapshot, name)
    return value.astype(np.float32) if name in ("uv_left", "uv_right") else value


def load_map(folder: Path | str, rig: Rig | None = None) -> SavedMap:
    """Read a map folder.

    Args:
        folder: as written by `--map-out` and `save_map`.
        rig: the camera to use the map with. Another one than the map's is reported.

    Raises:
        StereoSfmError: no map, another version, damaged, empty, or built with two cameras where `rig` is one, or the
            other way round.
    """
    folder = Path(folder).expanduser()
    head = read_header(folder, (*_FILES, "rig"))
    checksums = head["sha256"]
    columns: dict[str, Any] = {}
    try:
        for name, wanted in _FILES.items():
            raw = read_bytes(folder / f"{name}.npz")
            if checksum(raw) != checksums[name]:
                raise ValueError(name)
            data = read_arrays(raw)
            for c in set(_LATER).intersection(wanted).difference(data):
                data[c] = np.zeros((len(data[KEYS[name]]), *COLUMNS[c].shape), COLUMNS[c].dtype)
            columns.update({c: data[c] for c in wanted})
        for name, file in (("rig", RIG), ("cameras", CAMERAS)):
            if name in checksums and checksum(read_bytes(folder / file)) != checksums[name]:
                raise ValueError(name)
        own = MapCamera(read_native(folder / RIG))
        cameras = read_cameras(folder / CAMERAS) if "cameras" in checksums else {}
    except (OSError, KeyError, ValueError, StereoSfmError):
        raise damaged(folder, "a file is missing or was changed") from None
    try:
        check_columns(columns)
    except ValueError as error:
        raise damaged(folder, str(error)) from None
    sessions = columns.pop("sessions")
    for name in ("uv_left", "uv_right"):
        columns[name] = columns[name].astype(np.float64)
    snapshot = MapSnapshot(**columns)
    if not len(snapshot.kf_ids) or not len(snapshot.points):
        raise StereoSfmError(f"the map {folder} is empty: it has no keyframes or no points")
    saved = SavedMap(snapshot, cameras, head["vocabulary"], sessions)
    if not cameras:
        cameras.update(dict.fromkeys(saved.session_ids, own))
    if not cameras.keys() >= set(saved.session_ids):
        raise damaged(folder, f"{CAMERAS} lacks a session")
    counts = _counts(saved)
    for name in COUNTS:
        if head[name] != counts[name]:
            raise damaged(folder, f"map.json says {head[name]} {name}, the files have {counts[name]}")
    if rig is not None:
        _check_camera(folder, saved.cameras[saved.session_ids[-1]], rig)
    return saved


def _check_camera(folder: Path, last: MapCamera, rig: Rig) -> None:
    """Report what another camera differs by.

    Raises:
        StereoSfmError: distances are known to one of them only.
    """
    own = last.rig
    if own.stereo != rig.stereo:
        raise StereoSfmError(f"the map {folder} cannot be used with this camera: {difference(own, rig)}")
    if min((difference(x, rig, corrected=True) for x in (own, last.calibrated)), key=len):
        log.warning("the map %s was built with another camera: this one has %s", folder, difference(own, rig))
    if abs(own.readout_s - rig.readout_s) > 1e-3:
        log.warning(
            "the map %s was built with %s, this camera has %s: check readout_s in rig.yaml",
            folder, own.shutter, rig.shutter,
        )  # fmt: skip


def restore_map(snapshot: MapSnapshot) -> Map:
    """A `Map` that can be extended, with the same ids."""
    map_ = Map()
    map_.add_points(snapshot.pt_ids, snapshot.points, 0)
    map_.points.anchor[:] = snapshot.anchors
    for k, map_T_kf in zip(snapshot.keyframes(), snapshot.map_T_kf, strict=True):
        row = map_.add_keyframe(k, map_T_kf)
        map_.observe(row, map_.point_rows(k.point_ids), k.uv_left, k.uv_right, k.descriptors)
    map_.points.seen[:] = snapshot.seen
    map_.points.expected[:] = snapshot.expected
    return map_


def session_trajectory(saved: SavedMap, session: int) -> Trajectory:
    """The keyframes of one session in temporal order.

    Raises:
        StereoSfmError: two of them have the same stamp.
    """
    rows = np.flatnonzero(saved.sessions == session)
    rows = rows[saved.snapshot.stamp_ns[rows].argsort(kind="stable")]
    stamp_ns = saved.snapshot.stamp_ns[rows]
    if (np.diff(stamp_ns) <= 0).any():
        raise StereoSfmError(
            f"session {session} of the map has two keyframes of the same stamp: it is not a single session"
        )
    return Trajectory(stamp_ns, saved.snapshot.map_T_kf[rows])


def joined(maps: list[SavedMap]) -> SavedMap:
    """Concatenate maps: ids, submaps and sessions of later ones are offset to follow those of earlier ones.

    Raises:
        StereoSfmError: one was built with one camera, another with two.
    """
    first = maps[0]
    parts: dict[str, list[Any]] = {f.name: [] for f in dataclasses.fields(MapSnapshot)}
    sessions: list[Any] = []
    cameras: dict[int, MapCamera] = {}
    ids: dict[str, int] = {"kf_ids": 0, "pt_ids": 0, "submap_ids": 0}  # the first of this map
    rows: dict[str, int] = {"": 0, "keyframes": 0, "points": 0}
    next_session = 0
    for saved in maps:
        if saved.rig.stereo != first.rig.stereo:
            raise StereoSfmError(f"these maps cannot be merged: {difference(first.rig, saved.rig)}")
        s = saved.snapshot
        for name, values in parts.items():
            by = ids.get(name, rows[COLUMNS[name].index])
            values.append(getattr(s, name) + by if by else getattr(s, name))
        sessions.append(saved.sessions + next_session)
        cameras |= {next_session + k: saved.cameras[k] for k in saved.session_ids}
        next_session += int(saved.sessions.max()) + 1
        for name in ids:
            ids[name] += int(getattr(s, name).max()) + 1
        rows["keyframes"] += len(s.kf_ids)
        rows["points"] += len(s.pt_ids)
    snapshot = MapSnapshot(**{name: np.concatenate(values) for name, values in parts.items()})
    return SavedMap(snapshot, cameras, first.vocabulary_id, np.concatenate(sessions))


def as_update(saved: SavedMap) -> MapUpdate:
    """A whole map as one message of the mapper."""
    s = saved.snapshot
    return MapUpdate(1, int(s.kf_ids[-1]), s.kf_ids.copy(), s.map_T_kf.copy(), s.pt_ids.copy(), s.points.copy())
