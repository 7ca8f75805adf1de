"""The maps that a run loads and saves."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.log.provenance import Opening
from stereo_sfm.loop.vocabulary_file import configured_vocabulary
from stereo_sfm.mapping.protocol import AnyMapper
from stereo_sfm.maps.header import checksum
from stereo_sfm.timing import NoSpans

if TYPE_CHECKING:
    from stereo_sfm.maps.saved_map import SavedMap

log = logging.getLogger("stereo_sfm")


@dataclass(frozen=True)
class MapFolders:
    """With `localize_only` the odometry is localized in the map at `map_in`, which stays unchanged. Otherwise the
    session is mapped as usual, transformed into the map at `map_in`, if any, once relocalized, and merged with it when
    saved to `map_out`."""

    map_in: Path | None = None
    localize_only: bool = False
    map_out: Path | None = None
    kept: Path | None = None  # folder of the run's own map, for later exports; None: not saved
    session: Path | None = None  # folder for `unfinished.save_session` at the end; None: not saved

    def check(self, overwrite: bool = False) -> None:
        """Raises StereoSfmError for invalid combinations, before anything is computed."""
        if self.localize_only and self.map_in is None:
            raise StereoSfmError("--localize-only needs a map: add --map-in DIR")
        if self.localize_only and self.map_out is not None:
            raise StereoSfmError("--localize-only changes no map: omit --map-out")
        if self.map_in is not None and not (self.map_in / "map.json").exists():
            raise StereoSfmError(f"no map at {self.map_in}: 'stereo-sfm run ... --map-out DIR' creates one")
        if self.map_out is not None and self.map_out.exists() and not overwrite:
            raise StereoSfmError(f"{self.map_out} exists: choose another --map-out, or add --overwrite")
        if self.map_out is not None and self.map_out.exists() and not self.map_out.is_dir():
            raise StereoSfmError(f"{self.map_out} is a file: --map-out takes a folder")
        if self.map_out is not None:
            above = next(folder for folder in self.map_out.absolute().parents if folder.exists())
            if not above.is_dir() or not os.access(above, os.W_OK):
                why = "is not writable" if above.is_dir() else "is not a folder"
                raise StereoSfmError(f"cannot create --map-out {self.map_out}: {above} {why}")

    def opening(self, opening: Opening) -> Opening:
        """The opening of the source, completed with the map that the run loads."""
        if self.map_in is None:
            return opening
        place, sha256 = str(self.map_in.resolve()), map_sha256(self.map_in)
        return replace(opening, map_in=place, map_sha256=sha256, localize_only=self.localize_only)


def map_sha256(folder: Path) -> str:
    """Identifies a saved map: its map.json contains the checksums of all its files."""
    return checksum(read_bytes(folder / "map.json"))


def make_mapper(config: Config, rig: Rig, spans: NoSpans, folders: MapFolders) -> AnyMapper:
    """The mapper, or the localizer in a saved map."""
    if not folders.localize_only and not config.mapper.enabled and (folders.map_in or folders.map_out):
        raise StereoSfmError("maps need the mapper: set mapper.enabled=true, or omit --map-in and --map-out")
    if folders.localize_only and not config.mapper.enabled and not config.loop.enabled:
        raise StereoSfmError("--localize-only needs place recognition: set loop.enabled=true")
    from stereo_sfm.calibration.self_calibration import SelfCalibration
    from stereo_sfm.calibration.sensor_calibration import SensorCalibration
    from stereo_sfm.mapping.mapper import Mapper

    wanted = SelfCalibration.from_config(config, rig) if config.mapper.enabled else None
    sensors = SensorCalibration.from_config(config, rig)
    if folders.map_in is None:
        return Mapper(config.mapper, rig, spans, config.loop, wanted, sensors)
    from stereo_sfm.maps.extension import Extension
    from stereo_sfm.maps.kept_correction import KeptCorrection
    from stereo_sfm.maps.localizer import Localizer
    from stereo_sfm.maps.relocalization import Relocalizer
    from stereo_sfm.maps.saved_map import load_map

    saved = load_map(folders.map_in, rig)
    kept = saved.correction_of(rig)
    if wanted is not None and wanted.applies and kept.any():
        wanted = KeptCorrection(rig, kept, wanted.applies)
    vocabulary = configured_vocabulary(config.loop)
    relocalizer = Relocalizer(saved.snapshot, rig, vocabulary, config.loop, saved.keyframe_rigs([rig]))
    if folders.localize_only:
        return Localizer(relocalizer, wanted)
    return Extension(config.mapper, rig, spans, config.loop, Localizer(relocalizer), wanted, sensors)


def saved_map_of(mapper: AnyMapper, config: Config) -> SavedMap | None:
    """The map of a run for saving; None if nothing was mapped."""
    from stereo_sfm.maps.cameras import MapCamera
    from stereo_sfm.maps.saved_map import SavedMap

    snapshot = mapper.snapshot()
    if snapshot is None or not len(snapshot.kf_ids) or not len(snapshot.points):
        return None
    vocabulary = configured_vocabulary(config.loop)
    return SavedMap.of_session(snapshot, MapCamera(*mapper.calibration), vocabulary.id)


def save_result(mapper: AnyMapper, config: Config, folders: MapFolders) -> None:
    """Write the map of a finished run to `map_out`, merged with `map_in`, and to `kept`.

    A run that continues a saved map without `map_out` saves nothing: its part alone is in the saved map's frame.

    Raises:
        StereoSfmError: it cannot be merged, or another process writes to the map, and the session's own map was written
            instead (next to `map_out` where that must stay as it is).
        OSError: the map cannot be written.
    """
    from stereo_sfm.maps.merge import merge
    from stereo_sfm.maps.saved_map import load_map, save_map
    from stereo_sfm.maps.store import lock_versioned

    kept = folders.kept if folders.map_in is None or folders.map_out is not None else None
    if folders.map_out is None and kept is None:
        return
    saved, out, failure = saved_map_of(mapper, config), folders.map_out, ""
    if saved is None:
        if out is not None and not folders.localize_only:
            log.warning("nothing was mapped: no map is written to %s", out)
        return
    with contextlib.ExitStack() as held:
        if out is not None:
            stays = True  # what is in `out`
            try:
                held.enter_context(lock_versioned(out))
                stays = folders.map_in is not None and out.resolve() == folders.map_in.resolve()
                if folders.map_in is not None:
                    both, vocabulary = [load_map(folders.map_in), saved], configured_vocabulary(config.loop)
                    place = mapper.place(both[0].snapshot)
                    saved = merge(both, vocabulary, config.loop, config.mapper, place).saved
            except StereoSfmError as error:
                if stays:  # an unused name next to it
                    names = (out.parent / f"{out.name}_walk{k}" for k in itertools.count(1))
                    out = next(name for name in names if not name.exists())
                what = f"merged with {folders.map_in}" if folders.map_in else f"saved to {folders.map_out}"
                failure = f"not {what}: {error}; {out} contains this session alone"
        for folder in dict.fromkeys(place.absolute() for place in (out, kept) if place is not None):
            save_map(saved, folder)
    if failure:
        raise StereoSfmError(failure)
