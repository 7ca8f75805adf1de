"""The simulated store as a source: bits, truth, options."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.sim.world import Layout
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import StereoImage

SMALL = Layout(gondolas=2, gondola_length=5.0, products=40)


def small(name: str = "loop", **options: object) -> SimSource:
    """A named scene's drive in a store that is quick to build, small images."""
    scene = dataclasses.replace(SCENES[name], layout=SMALL)
    return SimSource(name, scene, read_options(SimOptions, "sim", {"size": "212x200", **options}))


def same(a: StereoImage, b: StereoImage) -> bool:
    assert a.right is not None and b.right is not None
    return bool((a.left == b.left).all() and (a.right == b.right).all()) and a.stamp_ns == b.stamp_ns


@pytest.mark.parametrize(
    "options", [{"name": "people"}, {"round": 0.5, "glossy": 0.5, "glass": 0.5, "polish": 1, "carts": 3, "shutter": 3}]
)
def test_single_frames_and_frames_in_order_have_the_same_bits(options: dict[str, Any]) -> None:
    in_order = list(small(**options, start=40, frames=3))
    other = small(**options)
    for image in reversed(in_order):
        assert same(image, other.frame(image.frame_id))
    assert not same(in_order[0], in_order[1])


def test_an_exposure_is_the_mean_of_what_is_seen_during_it() -> None:
    """Rendered so, it agrees with blur along the pixels' motion, but where something is hidden and appears."""
    options = {"noise": 0, "blur": 5, "size": "424x400", "speed": 1.0}
    exact, along, sharp = (
        small(**{**options, **more}).frame(200).left.astype(float) for more in ({"shutter": 9}, {}, {"blur": 0.0})
    )
    assert np.abs(along - exact).mean() < 0.5 * np.abs(sharp - exact).mean()
    assert np.abs(along - exact).max() > 8


def test_seed_session_and_effects_change_the_images() -> None:
    base = small().frame(100)
    changes: list[dict[str, Any]] = [
        {"seed": 1},
        {"walk": 1},
        {"effects": "off"},
        {"exchange": 0.5},
        {"noise": 0.5},
        {"blur": 9},
        {"gaps": 0.5},
        {"round": 0.5},
        {"hanging": 0.5},
        {"polish": 1},
        {"bare": 0.5},
    ]
    for options in changes:
        assert (small(**options).frame(100).left != base.left).mean() > 0.02, options


def test_another_calibration_does_not_change_the_images() -> None:
    """`--rig` changes the calibration of tracking, not the camera."""
    spec = {"camera": "pinhole", "vibration": 3.0, "readout": 0.05}
    source, believed = small(**spec), small(**spec)
    believed.rig = dataclasses.replace(small().rig, readout_s=0.0)
    assert same(source.frame(7), believed.frame(7))
    assert not same(source.frame(7), small(**{**spec, "readout": 0.0}).frame(7))


def test_named_scenes_open_by_the_source_table() -> None:
    source = open_source("sim:aisle?camera=pinhole&size=160x100&length=2&seed=5")
    with source:
        image = next(iter(source))
        assert source.name == "sim:aisle"
        assert image.left.shape == (100, 160) == source.rig.left.size[::-1]
        assert source.rig.baseline == pytest.approx(0.075)
        assert source.ground_truth is not None and source.frame_count == len(source.ground_truth)
        assert 1.5 < source.ground_truth.length < 2.3
    assert image.left.std() > 10


def test_truth_belongs_to_the_frames_that_arrive() -> None:
    whole, holed = small(frames=60), small(frames=60, drop=0.3)
    assert whole.ground_truth is not None and holed.ground_truth is not None
    assert holed.frame_count is not None and 25 < holed.frame_count < 58
    previous = -1
    for n, k in enumerate(holed.frame_ids.tolist()):
        assert (holed.ground_truth.poses[n] == whole.ground_truth.poses[k]).all()
        assert holed.ground_truth.stamp_ns[n] == whole.ground_truth.stamp_ns[k] == holed.stamp_ns(k)
        previous = k
    assert previous > 0
    images = [image for image, _ in zip(holed, range(4), strict=False)]
    gaps = np.diff([-1, *(i.frame_id for i in images)]) - 1
    assert [i.dropped_before for i in images] == gaps.tolist()
    assert same(images[-1], dataclasses.replace(whole.frame(images[-1].frame_id)))


@pytest.mark.parametrize("name", sorted(SCENES))
@pytest.mark.parametrize("session", [0, 1])
def test_drives_are_smooth_and_keep_clear_of_the_shelves(name: str, session: int) -> None:
    scene = SCENES[name]
    drive = small_drive(name, session)
    seconds = np.arange(0, drive.duration, 0.01)
    poses = drive.poses(seconds)
    twist = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / 0.01
    assert np.linalg.norm(twist[:, :3], axis=1).max() < 1.35
    assert np.rad2deg(np.linalg.norm(twist[:, 3:], axis=1)).max() < 90
    jerk = np.diff(twist, n=2, axis=0) / 0.01**2
    assert np.abs(jerk).max() < 120  # a corner of a polyline would be thousands
    at = poses[:, :2, 3]
    for k in range(scene.layout.gondolas):
        y = scene.layout.gondola_y(k)
        lo = np.array([scene.layout.margin, y - 0.56])
        hi = np.array([scene.layout.margin + scene.layout.gondola_length, y + 0.56])
        assert np.linalg.norm(np.maximum(np.maximum(lo - at, at - hi), 0), axis=1).min() > 0.6
    assert np.abs(np.linalg.det(poses[:, :3, :3]) - 1).max() < 1e-9


def small_drive(name: str, session: int):
    """The scene's own drive, without building its store."""
    from stereo_sfm.drivers.sim.drives import Drive

    scene = SCENES[name]
    route = scene.route(scene.layout, session, True)
    return Drive(route, scene.gait, np.random.default_rng([0, session, 31]), scene.length)


def test_the_loop_returns_and_overlaps() -> None:
    drive = small_drive("loop", 0)
    poses = drive.poses(np.arange(0, drive.duration, 1 / 30))
    at, ahead = poses[:, :2, 3], poses[:, :3, 2]
    late = np.arange(len(at)) > 600
    near = np.linalg.norm(at[late][:, None] - at[None, :200], axis=2) < 0.3
    again = near & ((ahead[late][:, None] * ahead[None, :200]).sum(2) > 0.97)
    assert again.any(1).sum() > 60  # two seconds and more in the tracks of the beginning


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ("sim:shop", "unknown scene"),
        ("sim:loop?colour=1", "no option 'colour'"),
        ("sim:loop?camera=gopro", "one of fisheye, pinhole"),
        ("sim:loop?seed=x", "whole number"),
        ("sim:loop?rate=0", "from 1 to 1000"),
        ("sim:loop?size=big", "WIDTHxHEIGHT"),
        ("sim:loop?effects=maybe", "on or off"),
        ("sim:loop?exchange=nan", "from 0 to 1"),
        ("sim:loop?dark=5", "FROM-TO"),
        ("sim:loop?dark=5-nan", "FROM-TO"),
    ],
)
def test_bad_specs_are_one_line(spec: str, text: str) -> None:
    with pytest.raises(StereoSfmError, match=text) as caught:
        open_source(spec)
    assert "\n" not in str(caught.value)


def test_start_beyond_the_end() -> None:
    with pytest.raises(StereoSfmError, match="beyond"):
        small(start=10**6)


def test_default_is_the_loop() -> None:
    with pytest.raises(StereoSfmError, match="beyond"):
        open_source("sim", start=10**6)


def test_bundled_recording_is_what_its_command_renders() -> None:
    """The demo is from the present simulator: same rig, same ground truth, same images up to JPEG's loss."""
    recording = Path(__file__).parents[2] / "recordings" / "demo.mcap"
    script = (recording.parent / "make_demo.py").read_text()
    spec = next(line.split('"')[1] for line in script.splitlines() if line.startswith("SOURCE"))
    source = open_source(spec)
    assert isinstance(source, SimSource) and source.ground_truth is not None
    with open_source(recording) as recorded:
        assert recorded.ground_truth is not None
        assert recorded.frame_count == source.frame_count == len(recorded.ground_truth)
        assert np.allclose(recorded.ground_truth.poses, source.ground_truth.poses, atol=1e-9)
        assert np.allclose(recorded.rig.left.params, source.rig.left.params)
        assert np.allclose(recorded.rig.left_T_right, source.rig.left_T_right)
        for image in itertools.islice(recorded, 0, 21, 20):
            rendered = source.frame(image.frame_id)
            assert image.stamp_ns == rendered.stamp_ns
            assert image.right is not None and rendered.right is not None
            for a, b in ((image.left, rendered.left), (image.right, rendered.right)):
                assert np.abs(a.astype(float) - b).mean() < 3.0


def test_the_lights_go_out_for_a_while() -> None:
    source = small("loop", dark="0.1-0.2", rate=30)
    levels = [float(source.frame(k).left.mean()) for k in range(8)]
    assert all((level < 10) == (3 <= k < 6) for k, level in enumerate(levels))
    assert source.frame(0).left.max() > 100 and source.frame(4).left.max() < 30


ENCOUNTER_SHARES = {  # kind: least and most share of the fuller camera's view at the fullest moment
    "approach": (0.2, 1.0), "stop": (0.1, 1.0), "cover": (0.85, 1.0), "lens": (0.7, 1.0), "cart": (0.08, 0.8),
    "beside": (0.05, 0.7), "group": (0.2, 0.8),
}  # fmt: skip


@pytest.mark.parametrize("kind", ENCOUNTER_SHARES)
def test_encounters_fill_the_view_and_leave_it_free_again(kind: str) -> None:
    least, most = ENCOUNTER_SHARES[kind]
    source = small("loop", encounters=kind, speed=0.8, rate=15, seed=4)
    encounter = source.encounters[0]
    frames = np.arange(np.ceil(encounter.begin * 15), encounter.end * 15, max(1.0, (encounter.end - encounter.begin)))
    shares = np.array([source.moving_share(int(k)) for k in frames])
    assert least < shares.max() <= most
    assert source.moving_share(int(encounter.begin * 15) - 2).max() == 0
    assert source.moving_share(int(np.ceil(encounter.end * 15)) + 2).max() == 0
    assert all(a.end < b.begin for a, b in itertools.pairwise(source.encounters))


def test_encounters_come_by_turns_and_from_the_seed() -> None:
    one, same_seed, other = (small("loop", encounters="cart,cover", seed=seed) for seed in (1, 1, 2))
    assert [e.kind for e in one.encounters[:4]] == ["cart", "cover", "cart", "cover"]
    assert [e.end for e in one.encounters] == [e.end for e in same_seed.encounters]
    assert [e.end for e in one.encounters] != [e.end for e in other.encounters]
    assert same(one.frame(200), same_seed.frame(200))
    assert {e.kind for e in small("loop", encounters="all", length=1000.0).encounters} == set(ENCOUNTER_SHARES)
    with pytest.raises(StereoSfmError, match="unknown encounter 'dance'"):
        small("loop", encounters="cart,dance")


def test_a_person_walking_beside_the_robot_keeps_the_distance() -> None:
    source = small("loop", encounters="beside", speed=0.8, length=30.0)
    encounter = source.encounters[0]
    gaps = [
        float(np.linalg.norm(encounter.at(t)[0].at[:2] - source.drive.poses(np.array([t]))[0, :2, 3]))
        for t in np.arange(encounter.begin + 3, encounter.end - 3, 0.5)
    ]
    assert min(gaps) > 0.5 and max(gaps) < 2.2
