"""What the dense reconstruction of a run or a map is made of: its map, and the recordings that hold its images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.calib import load_rig
from stereo_sfm.dense.keyframe_depth import KeyframeImages, check_rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.keyframe_images import open_recording, session_of_recording
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_run
from stereo_sfm.maps.floor import floor_of
from stereo_sfm.maps.saved_map import SavedMap, load_map
from stereo_sfm.maps.store import read_about
from stereo_sfm.types import F64

RUN_LOG, RUN_MAP = "run.mcap", "map"


@dataclass(frozen=True)
class DenseInput:
    """A map with the recordings of its sessions."""

    saved: SavedMap
    recordings: tuple[str, ...]
    rig: Path | None  # calibration of the recordings instead of their own
    run: Path | None = None  # folder of the run over them, if it is known
    store: Path | None = None  # folder of the map

    @property
    def map_T_floor(self) -> F64:
        """(4, 4) the floor's frame: a store's own, in which its plans and labels are.

        Raises:
            StereoSfmError: the store's description is damaged, or the vertical direction is not known.
        """
        if self.store is not None:
            return read_about(self.store, self.saved).map_T_floor
        return floor_of(self.saved)


def find_input(folder: Path, images: Sequence[str] = (), rig: Path | None = None) -> DenseInput:
    """The map and the images of a run's folder, a map's folder, or the map that a service keeps.

    Raises:
        StereoSfmError: no map, or nothing says where the images are.
    """
    if not folder.is_dir():
        raise StereoSfmError(f"{folder} is not the folder of a run or a map")
    place = folder / RUN_MAP if (folder / RUN_MAP / "map.json").is_file() else folder
    saved = load_map(place)
    recordings = tuple(images) or _own_images(folder)
    return DenseInput(saved, recordings, rig, folder, place)


def _own_images(folder: Path) -> tuple[str, ...]:
    """The log of a run where it has images, else the source that it read."""
    path = folder / RUN_LOG
    if not path.is_file():
        raise StereoSfmError(
            f"{folder} holds no images: name the recording of this map with --images SOURCE, "
            "or run again with --log full"
        )
    with LogReader(path) as reader:
        run = read_run(reader)
    if run.image_format not in ("none", ""):
        return (str(path),)
    if run.source and Path(run.source.partition("?")[0].split(":", 1)[-1]).exists():
        return (run.source,)
    raise StereoSfmError(
        f"{path} was written without images and its source {run.source or '(unnamed)'} is not here: "
        "run again with --log full, or name the recording with --images SOURCE"
    )


def keyframes(given: DenseInput) -> Iterator[KeyframeImages]:
    """Keyframes with their images, recording by recording, in the order of their frames.

    Raises:
        StereoSfmError: a recording of another camera, or one that lacks keyframes.
    """
    saved, s = given.saved, given.saved.snapshot
    rigs = saved.keyframe_rigs()
    cameras = [saved.cameras[session] for session in saved.session_ids]
    own = load_rig(given.rig) if given.rig is not None else None
    for spec in given.recordings:
        with open_recording(spec, cameras, own, given.run) as source:
            session = session_of_recording(saved, source, spec)
            rows = {
                (int(s.frame_ids[k]), int(s.stamp_ns[k])): k for k in range(len(saved)) if saved.sessions[k] == session
            }
            for image in source:
                row = rows.pop((image.frame_id, image.stamp_ns), None)
                if row is None:
                    continue
                check_rig(rigs[row])
                yield KeyframeImages(row, rigs[row], s.map_T_kf[row], image.left, image.right)
                if not rows:
                    break
            if rows:
                raise StereoSfmError(
                    f"{spec} lacks {len(rows)} of the map's keyframes: is it the recording of this map?"
                )
