"""The images of a map's keyframes, read from the recording that the map was built from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from stereo_sfm.calib.rectification import PROJECTIONS
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.rectified import rectified
from stereo_sfm.drivers.source import Source, open_source, path_of
from stereo_sfm.drivers.start_checked import StartCheckedSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.colmap import image_names
from stereo_sfm.maps.cameras import MapCamera, difference
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import U8, StartCheck, StereoImage

Key = tuple[int, int]  # frame id, stamp in ns


def open_recording(
    spec: str, cameras: Sequence[MapCamera], own_rig: Rig | None = None, run: Path | None = None
) -> Source:
    """A recording, not yet entered, as seen by a camera of the map: unchanged, or rectified as in the run.

    Args:
        spec: the recording.
        cameras: of the map; as it was calibrated, or as corrected.
        own_rig: calibration that replaces the recording's own.
        run: folder of the run that made the map; its images are paired as it paired them.

    Raises:
        StereoSfmError: it was recorded with another camera.
    """
    source = open_source(spec, own_rig)
    for how in PROJECTIONS:
        try:
            seen = rectified(source, how)
        except StereoSfmError:  # one camera, or two that cannot be rectified this way
            continue
        if not all(difference(rig, seen.rig, corrected=True) for c in cameras for rig in (c.calibrated, c.rig)):
            check = None if run is None else _start_check(run, spec)
            return seen if check is None else StartCheckedSource(seen, False, replace(check, rig=""))
    other = difference(cameras[-1].rig, source.rig)
    raise StereoSfmError(
        f"the camera of {spec} is not the map's, rectified or not (it has {other}): give"
        " the recording of this map, and the --rig of its run if any"
    )


def _start_check(run: Path, spec: str) -> StartCheck | None:
    """What the first images of a run said, if this is the source that it read, and not its log, which is paired."""
    from stereo_sfm.log import topics
    from stereo_sfm.log.provenance import METADATA
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.log.recorded import messages

    if not (run / "run.mcap").is_file():
        return None
    with LogReader(run / "run.mcap") as reader:
        if path_of(reader.metadata(METADATA).get("source", "")).resolve() != path_of(spec).resolve():
            return None
        return next((found for _, found in messages(reader, (topics.START_CHECK,))), None)


def check_session(saved: SavedMap, session: int | None) -> None:
    """Raises StereoSfmError for a session that is not in the map."""
    if session is not None and session not in saved.session_ids:
        raise StereoSfmError(f"the map has no session {session} (it has {', '.join(map(str, saved.session_ids))})")


def session_of_recording(saved: SavedMap, recording: Iterable[StereoImage], name: str) -> int:
    """The session whose keyframes, identified by frame id and stamp, are all in a recording.

    Raises:
        StereoSfmError: no session of the map matches, or more than one.
    """
    if len(saved.session_ids) == 1:
        return saved.session_ids[0]
    frames = {(image.frame_id, image.stamp_ns) for image in recording}
    fits = [session for session in saved.session_ids if frames.issuperset(_names(saved, session, "left"))]
    if not fits:
        raise StereoSfmError(f"{name} lacks keyframes of every session of the map: is it one of its recordings?")
    if len(fits) > 1:
        raise StereoSfmError(
            f"{name} matches several sessions of the map ({', '.join(map(str, fits))}): choose one with --session N"
        )
    return fits[0]


def write_keyframe_images(
    saved: SavedMap, recording: Iterable[StereoImage], session: int, folder: Path, name: str = "the recording"
) -> None:
    """Write the keyframe images of one session as PNG below folder/images, named as in the COLMAP model.

    Raises:
        StereoSfmError: the recording lacks some of them, or one cannot be written.
    """
    names = {side: _names(saved, session, side) for side in ("left", "right")}
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


def _names(saved: SavedMap, session: int, side: str) -> dict[Key, str]:
    """The image names of one session by frame id and stamp."""
    s = saved.snapshot
    rows = zip(
        s.frame_ids.tolist(), s.stamp_ns.tolist(), image_names(saved, side), saved.sessions.tolist(), strict=True
    )
    return {(frame_id, stamp_ns): name for frame_id, stamp_ns, name, other in rows if other == session}


def _write(path: Path, pixels: U8) -> None:
    from stereo_sfm.pixels import write_image

    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, pixels)
