"""The pictures of a map's keyframes, taken from the recording that the map was made from."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from stereo_sfm.calib.rectification import PROJECTIONS
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.rectified import rectified
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.colmap import image_names
from stereo_sfm.maps.saved_map import SavedMap, describe_rig, same_rig
from stereo_sfm.types import U8, StereoImage

Key = tuple[int, int]  # frame id, stamp in ns


def open_pictures(spec: str, map_rig: Rig, own_rig: Rig | None = None) -> Source:
    """A recording, not yet entered, as the map's camera saw it: as it is, or rectified as the run had it.

    Args:
        spec: the recording.
        map_rig: the map's camera.
        own_rig: calibration instead of the recording's own.

    Raises:
        StereoSfmError: it was not taken with this camera.
    """
    source = open_source(spec, own_rig)
    for how in PROJECTIONS:
        try:
            seen = rectified(source, how)
        except StereoSfmError:  # one eye, or two that cannot be rectified this way
            continue
        if same_rig(seen.rig, map_rig):
            return seen
    raise StereoSfmError(
        f"the camera of {spec} ({describe_rig(source.rig)}) is not the map's ({describe_rig(map_rig)}), rectified or"
        " not: give the recording of this map, and --rig where the run had one"
    )


def check_walk(saved: SavedMap, walk: int | None) -> None:
    """Raises StereoSfmError for a walk that the map does not hold."""
    if walk is not None and walk not in saved.walks:
        raise StereoSfmError(f"the map holds no walk {walk} (it holds {', '.join(map(str, saved.walks))})")


def walk_of_recording(saved: SavedMap, recording: Iterable[StereoImage], name: str) -> int:
    """The walk whose keyframes, told by frame id and time, are all in a recording.

    Raises:
        StereoSfmError: no walk of the map is in it, or more than one could be.
    """
    if len(saved.walks) == 1:
        return saved.walks[0]
    frames = {(image.frame_id, image.stamp_ns) for image in recording}
    fits = [walk for walk in saved.walks if frames.issuperset(_names(saved, walk, "left"))]
    if not fits:
        raise StereoSfmError(f"{name} lacks keyframes of every walk of the map: is it one of its recordings?")
    if len(fits) > 1:
        raise StereoSfmError(
            f"{name} could be any of the walks {', '.join(map(str, fits))} of the map by its times: say --walk N"
        )
    return fits[0]


def write_pictures(
    saved: SavedMap, recording: Iterable[StereoImage], walk: int, folder: Path, name: str = "the recording"
) -> None:
    """PNG pictures of the keyframes of one walk under folder/images, named as the COLMAP model names them.

    Raises:
        StereoSfmError: the recording lacks some of them, or one cannot be written.
    """
    names = {eye: _names(saved, walk, eye) for eye in ("left", "right")}
    missing = set(names["left"])
    for image in recording:
        key = (image.frame_id, image.stamp_ns)
        if key in missing:
            missing.discard(key)
            _write(folder / "images" / names["left"][key], image.left)
            if image.right is not None:
                _write(folder / "images" / names["right"][key], image.right)
        if not missing:
            return
    raise StereoSfmError(f"{name} lacks {len(missing)} of the map's keyframes: is it the recording of this map?")


def _names(saved: SavedMap, walk: int, eye: str) -> dict[Key, str]:
    """The pictures of one walk by frame id and time."""
    s = saved.snapshot
    rows = zip(s.frame_ids.tolist(), s.stamp_ns.tolist(), image_names(saved, eye), saved.sessions.tolist(), strict=True)
    return {(frame_id, stamp_ns): name for frame_id, stamp_ns, name, session in rows if session == walk}


def _write(path: Path, pixels: U8) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), pixels):
        raise StereoSfmError(f"cannot write {path}")
