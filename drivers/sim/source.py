"""`sim:NAME?option=value&...`: the simulated store as a source of stereo frames with ground truth."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.sim.drives import Drive, Gait
from stereo_sfm.drivers.sim.effects import CLEAN, Effects, Sensor, brightness
from stereo_sfm.drivers.sim.encounters import plan as plan_encounters
from stereo_sfm.drivers.sim.encounters import present
from stereo_sfm.drivers.sim.inertial import InertialSensor
from stereo_sfm.drivers.sim.kernels import PERSON
from stereo_sfm.drivers.sim.lens_errors import LensErrors
from stereo_sfm.drivers.sim.market import GAIT, Market, build_market, plan, session_path, shoppers
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.paths import RobotPath, joined, read_paths, with_spot_turns
from stereo_sfm.drivers.sim.people import crowd_at, moving
from stereo_sfm.drivers.sim.render import Renderer, View
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.drivers.sim.robot import RobotView
from stereo_sfm.drivers.sim.scenes import MARKET, SCENES, Scene, crowd
from stereo_sfm.drivers.sim.tables import Tables
from stereo_sfm.drivers.sim.wheels import WheelSensor
from stereo_sfm.drivers.sim.world import Layout, build_world
from stereo_sfm.drivers.source import BaseSource, Stamps
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, ImuSamples, StereoImage, Trajectory, WheelSamples

_EPOCH_NS = 1_000_000_000
LATE = 0.4  # of the interval between images, at most: stamps stay in order
PAUSES = 3.0  # widths of the smoothing for which a robot rests before it turns on the spot, and afterwards


@functools.lru_cache(maxsize=2)
def _world(layout: Layout | Market, seed: int, exchange: float, nights: int) -> Tables:
    if isinstance(layout, Market):
        return build_market(layout, seed, exchange, nights)
    return build_world(layout, seed, exchange, nights)


STOCK = ("fill", "gaps", "setback", "round", "hanging", "glossy", "clear", "glass", "bare", "polish", "carts")


def _stocked(layout: Layout | Market, options: SimOptions) -> Layout | Market:
    """The layout with the densities that are given."""
    given = {name: value for name in STOCK if (value := getattr(options, name)) >= 0}
    if not given:
        return layout
    if isinstance(layout, Market):
        return dataclasses.replace(layout, style=layout.style.with_stock(given))
    return layout.with_stock(given)


def _effects(scene: Scene, options: SimOptions) -> Effects:
    if not options.effects:
        return dataclasses.replace(CLEAN, drop=options.drop)
    e = scene.effects
    return dataclasses.replace(
        e,
        drop=options.drop,
        dirt=options.dirt,
        flicker=options.flicker,
        jpeg=options.jpeg,
        exposure_s=e.exposure_s * options.blur,
        read_noise=e.read_noise * options.noise,
        shot_noise=e.shot_noise * options.noise**2,
    )


def _noise_key(seed: int, frame_id: int, side: int) -> int:
    """64 bits that differ for every image."""
    return int(np.random.SeedSequence([seed, frame_id, side]).generate_state(1, np.uint64)[0])


def _check_inside(path: RobotPath, layout: Layout) -> None:
    """Raises:
    StereoSfmError: the path leads out of the store or through its gondolas.
    """
    at = path.course[:, :2]
    out = ((at < 0.3) | (at > np.array(layout.room[:2]) - 0.3)).any(1)
    x0, x1, half = layout.margin, layout.margin + layout.gondola_length, layout.gondola_depth + 0.1
    for k in range(layout.gondolas):
        out |= (at[:, 0] > x0) & (at[:, 0] < x1) & (np.abs(at[:, 1] - layout.gondola_y(k)) < half)
    if out.any():
        x, y = at[int(np.argmax(out))]
        raise StereoSfmError(
            f"sim: the path leads to ({x:.1f}, {y:.1f}) m, into a wall or a shelf of this {layout.room[0]:.0f} x"
            f" {layout.room[1]:.0f} m store: move it, or let sim:market build a store around it"
        )


class SimSource(BaseSource):
    """A source (stereo_sfm.drivers.source.Source) that can also render single frames, with the same bits."""

    def __init__(self, name: str, scene: Scene, options: SimOptions) -> None:
        self.name = f"sim:{name}"
        self.options = options
        self.live = options.realtime
        self.rig = dataclasses.replace(make_rig(options.camera, options.size), readout_s=options.readout)
        self._camera = self.rig  # the true rig, also if another calibration is used
        self.layout = _stocked(scene.layout, options)
        self.effects = _effects(scene, options)
        self._dark = options.dark
        gait = dataclasses.replace(
            scene.gait,
            speed=options.speed or scene.gait.speed,
            turn_seconds=options.corner or scene.gait.turn_seconds,
            rest_seconds=options.rest or scene.gait.rest_seconds,
            vibration=scene.gait.vibration * options.vibration,
            thresholds=options.thresholds,
            ramps=options.ramps,
            pushed=options.pushed,
        )
        self.drive = self._drive(scene, gait)
        if options.stamped not in (0.0, options.rate) and (options.imu or options.wheel):
            raise StereoSfmError("sim: an IMU and wheels have the true time: leave stamped away")
        self._inertial = None
        if options.imu:
            seeds = np.random.default_rng([options.seed, options.walk, 83])
            self._inertial = InertialSensor(options.imu, self.drive, seeds, options.imu_offset_ms * 1e-3)
            self.rig = self._camera = dataclasses.replace(self.rig, imu=self._inertial.imu)
        self._wheels = None
        if options.wheel:
            seeds = np.random.default_rng([options.seed, options.walk, 89])
            self._wheels = WheelSensor(
                options.wheel,
                options.wheel_grade,
                options.wheel_slip,
                self.drive,
                seeds,
                options.wheel_offset_ms * 1e-3,
            )
            self.rig = self._camera = dataclasses.replace(self.rig, wheel=self._wheels.wheel)
        count = scene.people if options.people < 0 else options.people
        people = np.random.default_rng([options.seed, 47])
        if isinstance(scene.layout, Market):
            self.people = shoppers(plan(options.path)[1], count, people)
        else:
            self.people = crowd(scene.layout, count, people)
        self.encounters = plan_encounters(
            options.encounters, self.drive, np.random.default_rng([options.seed, options.walk, 71])
        )
        self._choose_frames()
        self._renderer: Renderer | None = None
        self._small_renderer: Renderer | None = None  # for `moving_share`
        self._sensors: list[Sensor] = []

    def _drive(self, scene: Scene, gait: Gait) -> Drive:
        """Along the scene's route or a recorded path."""
        o = self.options
        rng = np.random.default_rng([o.seed, o.walk, 31])
        routed = not (isinstance(scene.layout, Market) or o.path)
        if o.spot_turns and not routed:
            raise StereoSfmError("sim: a recorded path has its own turns: leave spot_turns away")
        length = o.length or scene.length
        if isinstance(scene.layout, Market):
            path = session_path(plan(o.path)[1], o.walk, o.length, rng)
        elif o.path:
            path = joined(read_paths(Path(o.path)))
            _check_inside(path, scene.layout)
            gait = dataclasses.replace(gait, speed=o.speed)
        else:
            route = scene.route(scene.layout, o.walk, o.returns)
            if not o.spot_turns:
                return Drive(route, gait, rng, length)
            path = with_spot_turns(route, gait.speed, PAUSES * gait.turn_seconds)
            gait = dataclasses.replace(gait, speed=0.0)
        return Drive.along(path.seconds, path.course, gait, rng, length)

    def _choose_frames(self) -> None:
        """Select the frames that arrive, and their ground truth."""
        o = self.options
        total = int(self.drive.duration * o.rate) + 1
        if o.start >= total:
            raise StereoSfmError(f"sim: start={o.start} is beyond the scene's {total} frames")
        last = min(total, o.start + o.frames) if o.frames else total
        ids = np.arange(o.start, last)
        if self.effects.drop > 0:
            lost = np.array([np.random.default_rng([o.seed, int(k), 61]).random() < self.effects.drop for k in ids])
            lost[0] = False
            ids = ids[~lost]
        self.frame_ids = ids
        self.frame_count = len(ids)
        self.ground_truth = Trajectory(
            np.array([self.stamp_ns(int(k)) for k in ids], np.int64), self.drive.poses(ids / o.rate)
        )

    def stamp_ns(self, frame_id: int) -> int:
        """Mid-exposure, on the simulated sensor's clock, with the errors that stamps may have."""
        o = self.options
        interval_s, late_s = 1.0 / (o.stamped or o.rate), 0.0
        if o.stamp_jitter_ms > 0:
            late_s = 1e-3 * o.stamp_jitter_ms * np.random.default_rng([o.seed, frame_id, 127]).normal()
            late_s = float(np.clip(late_s, -LATE * interval_s, LATE * interval_s))
        return _EPOCH_NS + round(frame_id * 1e9 / (o.stamped or o.rate)) + round(1e9 * late_s)

    @property
    def world(self) -> Tables:
        """The store, built when first needed."""
        return _world(self.layout, self.options.seed, self.options.exchange, self.options.nights)

    @property
    def renderer(self) -> Renderer:
        """Created when first needed."""
        if self._renderer is None:
            o = self.options
            errors = LensErrors(o.residual, o.decentered, o.tilted, o.rows)
            self._renderer = Renderer(self.world, self._camera, o.rays, errors.displacements(self._camera, o.seed))
            self._sensors = self._make_sensors(self._renderer)
        return self._renderer

    def _make_sensors(self, renderer: Renderer) -> list[Sensor]:
        camera, poses = self._camera.left, (np.eye(4), self._camera.left_T_right)
        ends = np.array([[camera.cx, camera.height - 1.0], [camera.width - 1.0, camera.cy]])
        down, side = np.nan_to_num(np.arccos(camera.unproject(ends)[:, 2]), nan=np.pi / 2)
        return [
            Sensor(
                rays,
                dataclasses.replace(self.effects, defocus_px=self.options.right_blur) if k else self.effects,
                RobotView(rays, poses[k], (down, side)) if self.options.robot else None,
                np.random.default_rng([self.options.seed, k, 101]),
            )
            for k, rays in enumerate(renderer.cameras)
        ]

    def pose(self, frame_id: int) -> F64:
        """world_T_cam0 (4, 4) of a frame."""
        return self.drive.poses(np.array([frame_id / self.options.rate]))[0]

    def row_poses(self, frame_id: int) -> F64:
        """world_T_cam0 of the rows of a frame: (H, 4, 4), or (4, 4) where all are exposed at once."""
        if self.options.readout == 0:
            return self.pose(frame_id)
        seconds = self._camera.row_seconds(np.arange(float(self._camera.left.height)))
        return self.drive.poses(frame_id / self.options.rate + seconds)

    def clean(self, frame_id: int) -> tuple[View, View]:
        """Brightness, depth and surfaces of a frame without the sensor's effects."""
        return self.view(self.row_poses(frame_id), frame_id / self.options.rate)

    def view(self, world_T_cam: F64, seconds: float = 0.0) -> tuple[View, View]:
        """Brightness, depth and surfaces from a pose (4, 4) or poses of rows (H, 4, 4), with people at `seconds`."""
        things = crowd_at(self.people, seconds) + present(self.encounters, seconds)
        return self.renderer.render(world_T_cam, moving(self.world, things))

    def _exposed(self, world_T_cam: F64, seconds: float, twist: F64) -> tuple[View, View]:
        """Mean brightness of `shutter` views while the shutter is open; depth and surfaces at its middle."""
        views, count = self.view(world_T_cam, seconds), self.options.shutter
        if count == 0:
            return views
        total = [np.zeros_like(view.image) for view in views]
        for after in (np.arange(count) + 0.5) / count * self.effects.exposure_s - 0.5 * self.effects.exposure_s:
            moved = self.view(world_T_cam @ se3.exp(after * twist), seconds + after)
            for image, view in zip(total, moved, strict=True):
                image += view.image / count
        left, right = (dataclasses.replace(view, image=image) for view, image in zip(views, total, strict=True))
        return left, right

    def moving_share(self, frame_id: int) -> F64:
        """Ground truth: the share (2,) of each camera's image that people and their things cover in a frame."""
        if self._small_renderer is None:
            size = (round(self._camera.left.width / 8), round(self._camera.left.height / 8))
            self._small_renderer = Renderer(self.world, make_rig(self.options.camera, size))
        seconds = frame_id / self.options.rate
        things = crowd_at(self.people, seconds) + present(self.encounters, seconds)
        if not things:
            return np.zeros(2)
        views = self._small_renderer.render(self.pose(frame_id), moving(self.world, things))
        return np.array([((view.ids >> 4) & 7 == PERSON)[view.ids >= 0].mean() for view in views])

    def image_at(self, world_T_cam: F64, frame_id: int = 0, twist: F64 | None = None) -> StereoImage:
        """The image of a frame from any pose.

        Args:
            world_T_cam: (4, 4), or (H, 4, 4) of the rows.
            frame_id: decides time, people and noise.
            twist: (6,) velocity in camera axes, metres and radians a second; for motion blur.
        """
        o, seconds = self.options, frame_id / self.options.rate
        twist = np.zeros(6) if twist is None else twist
        twists = [twist, se3.adjoint(se3.inverse(self._camera.left_T_right)) @ twist]
        dark = self._dark[0] <= seconds < self._dark[1]
        level = 0.0 if dark else brightness(self.effects, seconds, o.seed)
        views = self._exposed(world_T_cam, seconds, twist)  # first: it creates the sensors
        if o.shutter:
            twists = [np.zeros(6)] * 2
        left, right = (
            sensor.expose(view, twists[k], level * (o.right_exposure if k else 1.0), _noise_key(o.seed, frame_id, k))
            for k, (sensor, view) in enumerate(zip(self._sensors, views, strict=True))
        )
        exposure_us = self.effects.exposure_s * 1e6
        return StereoImage(frame_id, self.stamp_ns(frame_id), left, right, exposure_us=exposure_us, gain=level)

    def frame(self, frame_id: int, dropped_before: int = 0) -> StereoImage:
        """Render one frame."""
        seconds, step = frame_id / self.options.rate, 1e-4
        before, after = self.drive.poses(np.array([seconds - step, seconds + step]))
        twist = se3.log(se3.inverse(before) @ after) / (2 * step)
        image = self.image_at(self.row_poses(frame_id), frame_id, twist)
        imu, wheel = self.sampled(frame_id, dropped_before)
        return dataclasses.replace(image, dropped_before=dropped_before, imu=imu, wheel=wheel)

    def sampled(self, frame_id: int, dropped_before: int = 0) -> tuple[ImuSamples | None, WheelSamples | None]:
        """Inertial and wheel samples since the previous frame."""
        begin, end = (frame_id - 1 - dropped_before) / self.options.rate, frame_id / self.options.rate
        imu = None if self._inertial is None else self._inertial.samples(begin, end, _EPOCH_NS)
        return imu, None if self._wheels is None else self._wheels.samples(begin, end, _EPOCH_NS)

    def stamps(self) -> Stamps:
        return Stamps(np.array([self.stamp_ns(int(k)) for k in self.frame_ids], np.int64), 0.0)

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return (self.frame(int(k)) for k in self.frame_ids[list(positions)])

    def close(self) -> None:
        """Free the renderer's memory."""
        self._renderer, self._sensors = None, []

    def __iter__(self) -> Iterator[StereoImage]:
        began, previous = time.monotonic(), int(self.frame_ids[0]) - 1
        for n, k in enumerate(self.frame_ids.tolist()):
            if self.live:
                time.sleep(max(0.0, began + n / self.options.rate - time.monotonic()))
            yield self.frame(k, k - previous - 1)
            previous = k


def open_sim(scene: str, options: SimOptions) -> SimSource:
    """Open `sim:SCENE`; `stereo_sfm.drivers.sim.SCENES` names the scenes.

    Raises:
        StereoSfmError: incompatible options.
    """
    if scene == MARKET:
        source = SimSource(scene, Scene(plan(options.path)[0], gait=GAIT), options)
    else:
        source = SimSource(scene, SCENES[scene], options)
    source.rig = chosen_rig(options.rig, lambda: source.rig)
    return source
