"""The system for use in a program's own loop: images in; poses, the live map and places in saved maps out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stereo_sfm.calib.formats import load_rig
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.drivers.ascending import ascending
from stereo_sfm.drivers.checked_samples import SampleChecker
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.log.map_view import MapView
from stereo_sfm.loop.vocabulary_file import configured_vocabulary
from stereo_sfm.maps.folders import MapFolders, saved_map_of
from stereo_sfm.maps.relocalization import Location, Relocalizer, not_found
from stereo_sfm.maps.saved_map import SavedMap, load_map, save_map
from stereo_sfm.maps.single_image import still_keyframe
from stereo_sfm.maps.store import lock_versioned
from stereo_sfm.messages import Sink
from stereo_sfm.pipeline.image_input import ImageInput
from stereo_sfm.pipeline.inline import InlineRun
from stereo_sfm.pipeline.text import Listener
from stereo_sfm.pipeline.threads import limited_threads
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import F64, I64, Frame, ImuSamples, MapUpdate, Message, StereoImage, Trajectory, WheelSamples

M = TypeVar("M")


def _rig(rig: Rig | str | Path) -> Rig:
    return rig if isinstance(rig, Rig) else load_rig(rig)


class Tracker:
    """Odometry alone: one image in, one `Frame` out, no map and no loops.

    A frame has the pose `odom_T_cam`, its covariance, the state, the reason when there is no pose, and the
    points that were seen.
    """

    def __init__(self, rig: Rig | str | Path, config: Config | None = None) -> None:
        """Begin before the first image.

        Args:
            rig: the calibration or its file.
            config: the default when omitted.
        """
        self._rig = _rig(rig)
        self._input, self._samples = ImageInput(self._rig), SampleChecker()
        self._tracker = make_tracker(config or Config(), self._rig)

    def step(
        self,
        left: ArrayLike,
        right: ArrayLike | None,
        stamp_ns: int,
        depth: ArrayLike | None = None,
        imu: ImuSamples | None = None,
        wheel: WheelSamples | None = None,
    ) -> Frame:
        """Track the next image.

        Args:
            left: (H, W) 8-bit grey, or what `stereo_sfm.pipeline.image_input` accepts.
            right: the same; none for one camera and for RGB-D.
            stamp_ns: time of the exposure, whole nanoseconds.
            depth: (H, W) metres (RGB-D).
            imu: samples since the image before; used where the calibration has `imu`. What is doubled, out of order,
                not a number or in other units is left out, each with one line.
            wheel: samples of the wheels since then, likewise.

        Raises:
            StereoSfmError: not an image of this rig.
        """
        image = self._input.image(left, right, stamp_ns, depth, imu, wheel)
        return self._tracker.step(self._samples.checked(image))[0]


@dataclass(frozen=True, eq=False)
class LiveMap(Message):
    """The map as it is at one moment."""

    kf_ids: I64  # (K,) keyframes, ascending
    map_T_kf: F64  # (K, 4, 4) poses of the keyframes
    point_ids: I64  # (P,) ascending
    points: F64  # (P, 3) metres in the map


class _Callbacks:
    """A sink that hands each message to those who asked for its type."""

    def __init__(self) -> None:
        self._of: dict[type, list[Callable[[Any], object]]] = {}

    def add(self, kind: type, callback: Callable[[Any], object]) -> None:
        self._of.setdefault(kind, []).append(callback)

    def put(self, message: object) -> None:
        for callback in self._of.get(type(message), []):
            callback(message)


class System:
    """Tracking, mapping and loop closing in this process, one image at a time: the same bits as `stereo-sfm run`.

    That holds in a program that imports `stereo_sfm` before numpy, OpenCV and scipy (same_code.py). Use it in a `with`
    statement, or call `finish` after the last image, so that pending work reaches the map.
    """

    def __init__(
        self,
        rig: Rig | str | Path,
        config: Config | None = None,
        map_in: str | Path | None = None,
        localize_only: bool = False,
        sinks: Iterable[Sink] = (),
    ) -> None:
        """Begin before the first image.

        Args:
            rig: the calibration or its file.
            config: what decides the result; the default when omitted.
            map_in: folder of a saved map of this place to continue.
            localize_only: localize the camera in `map_in` without changing the map.
            sinks: each gets every message, in order.
        """
        self.rig, self.config = _rig(rig), config or Config()
        self._folders = MapFolders(None if map_in is None else Path(map_in).expanduser(), localize_only)
        self._folders.check()
        self._record, self._view = RunRecord.of(self.config, localize_only), MapView()
        self._callbacks = _Callbacks()
        self._map_T_odom: F64 = np.eye(4)
        self._callbacks.add(MapUpdate, self._take)
        self._input, self._samples = ImageInput(self.rig), SampleChecker()
        every = (self._record, self._callbacks, *sinks)
        self._run = InlineRun(MemorySource(self.rig, []), self.config, every, folders=self._folders)
        self._open = ExitStack()
        self._open.enter_context(Listener("main", self._run.add_line))
        self._open.enter_context(limited_threads(self.config.pipeline.threads))
        self._finished = False
        self.frame: Frame | None = None  # of the newest image

    def _take(self, update: MapUpdate) -> None:
        self._view.update(update)
        self._map_T_odom = update.map_T_odom

    def step(
        self,
        left: ArrayLike,
        right: ArrayLike | None,
        stamp_ns: int,
        depth: ArrayLike | None = None,
        imu: ImuSamples | None = None,
        wheel: WheelSamples | None = None,
    ) -> Frame:
        """Take the next image through all stages; the arguments are those of `Tracker.step`."""
        return self.step_image(self._input.image(left, right, stamp_ns, depth, imu, wheel))

    def step_image(self, image: StereoImage) -> Frame:
        """The same with an image of a source, which keeps its number."""
        if self._finished:
            raise StereoSfmError("this system is finished: create a new one")
        self.frame = self._run.step(self._samples.checked(self._input.checked(image)))
        return self.frame

    def run(self, images: Iterable[StereoImage]) -> Iterator[Frame]:
        """Every image through all stages, with ascending stamps as in a run; finishes after the last one."""
        for image in ascending(images, "images"):
            yield self.step_image(image)
        self.finish()

    def on(self, kind: type[M], callback: Callable[[M], object]) -> None:
        """Call back with every message of a type: `Frame`, `Keyframe`, `MapUpdate`, `LoopResult`, ..."""
        self._callbacks.add(kind, callback)

    def finish(self) -> None:
        """Call after the last image; further calls do nothing."""
        if not self._finished:
            self._finished = True
            with self._open:
                self._run.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.finish()
        else:
            self._finished = True
            self._open.close()

    # -- results ------------------------------------------------------------------------------------------------------

    @property
    def map_T_cam(self) -> F64 | None:
        """(4, 4) the newest image's pose in the map; None before the first pose, and until `map_in` is recognised."""
        placed = self._folders.map_in is None or self._run.map_stage.mapper.found
        known = self.frame is not None and placed and bool(self._record.tracked().any())
        return self._map_T_odom @ self.frame.odom_T_cam if known and self.frame is not None else None

    @property
    def map(self) -> LiveMap:
        """The map now."""
        kf_ids, map_T_kf = self._view.trajectory
        return LiveMap(kf_ids, map_T_kf, self._view.point_ids.copy(), self._view.points.copy())

    def trajectory(self, which: str = "map") -> Trajectory:
        """world_T_cam0 of the frames that have a pose.

        Args:
            which: "map", with the corrections of the map so far, or "odom", as odometry estimated it at the time.
        """
        if which not in ("map", "odom"):
            raise StereoSfmError(f"unknown trajectory '{which}': choose 'map' or 'odom'")
        mapped = self._record.mapped() if which == "map" else None
        return self._record.odometry() if mapped is None else mapped

    def saved_map(self) -> SavedMap:
        """The map, to be saved, exported, or used for localization.

        Raises:
            StereoSfmError: nothing is mapped.
        """
        saved = saved_map_of(self._run.map_stage.mapper, self.config)
        if saved is None:
            raise StereoSfmError("nothing is mapped: no keyframe, or mapper.enabled=false")
        return saved

    def save_map(self, folder: str | Path) -> None:
        """Write the map folder that `load_map` and `--map-in` read.

        Raises:
            StereoSfmError: nothing is mapped, or a service extends the map of that folder.
        """
        with lock_versioned(Path(folder).expanduser()):
            save_map(self.saved_map(), Path(folder).expanduser())


class MapLocator:
    """Localizes images in a saved map, without or with a prior pose."""

    def __init__(
        self, saved: SavedMap | str | Path, rig: Rig | str | Path | None = None, config: Config | None = None
    ) -> None:
        """Prepare a map for searches.

        Args:
            saved: a map, or its folder.
            rig: of the camera to localize; the map's own when omitted.
            config: its `loop` section is used.
        """
        self._config = config or Config()
        saved = saved if isinstance(saved, SavedMap) else load_map(saved)
        self._rig = saved.rig if rig is None else _rig(rig)
        vocabulary = configured_vocabulary(self._config.loop)
        own = saved.keyframe_rigs([self._rig])
        self._relocalizer = Relocalizer(saved.snapshot, self._rig, vocabulary, self._config.loop, own)

    def locate(self, left: ArrayLike, right: ArrayLike | None, near: F64 | None = None) -> Location:
        """Localize an image pair: `map_T_cam`, its information matrix, and `reason`, empty when found.

        Args:
            left: as `Tracker.step` takes it.
            right: the same.
            near: (4, 4) map_T_cam to search around only; None searches the whole map.
        """
        image = ImageInput(self._rig).image(left, right, 0)
        keyframe = still_keyframe(image, self._rig, config=self._config)
        if keyframe is None:
            return not_found("too_few_points")
        return self._relocalizer.locate(keyframe) if near is None else self._relocalizer.locate_near(keyframe, near)
