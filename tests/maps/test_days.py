"""A rig that is wrong, and knocked on the second day: it is corrected each day, in the map of the days before."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calibration.self_calibration import SelfCalibration
from stereo_sfm.config import Config, LoopConfig, MapperConfig
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.associate import poses_at
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.loop.vocabulary_file import configured_vocabulary
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.extension import Extension
from stereo_sfm.maps.folders import MapFolders, make_mapper, saved_map_of
from stereo_sfm.maps.localizer import Localizer
from stereo_sfm.maps.relocalization import Relocalizer
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.maps.unfinished import save_session
from stereo_sfm.maps.update import update
from stereo_sfm.pipeline.inline import InlineRun
from stereo_sfm.service.map_store import MapStore
from stereo_sfm.timing import NoSpans
from stereo_sfm.types import F64, RIG_TERMS, CalibrationUpdate, MapUpdate, StereoImage, Trajectory
from tests.loop.store_sequence import StoreSequence, make_sequence
from tests.maps.maps import map_of_sequence
from tests.synthetic import fisheye_rig, turned

TRUE = fisheye_rig()
WRONG = turned(TRUE, (0.3, 0.3, -0.3))


def left_deg(rig: Rig, true: Rig) -> float:
    """Rotation between right cameras in degrees."""
    return float(np.rad2deg(se3.extent(se3.inverse(rig.left_T_right) @ true.left_T_right)[1]))


# -- keyframes of a synthetic aisle ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def yesterday() -> StoreSequence:
    return make_sequence([0], seed=31, noise_px=0.1)


@pytest.fixture(scope="module")
def vocabulary(yesterday: StoreSequence) -> voc.Vocabulary:
    return voc.train([k.descriptors for k in yesterday.keyframes], depth=3)


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_rig_is_corrected_in_a_saved_map(
    yesterday: StoreSequence, vocabulary: voc.Vocabulary, localize_only: bool
) -> None:
    saved = map_of_sequence(yesterday)
    rigs, calibration = saved.keyframe_rigs([WRONG]), SelfCalibration(WRONG)
    relocalizer = Relocalizer(saved.snapshot, WRONG, vocabulary, LoopConfig(), rigs)
    localizer = Localizer(relocalizer, calibration if localize_only else None)
    mapper = localizer
    if not localize_only:
        mapper = Extension(MapperConfig(), WRONG, None, LoopConfig(), localizer, calibration)
    terms, updates = np.zeros(RIG_TERMS), list[MapUpdate]()
    for keyframe in make_sequence([0], seed=31, noise_px=0.1).keyframes:
        updates.append(mapper.step(replace(keyframe, rig_terms=terms)))
        if (revised := updates[-1].calibration) is not None:
            assert revised.applied
            assert revised.version == updates[-1].version
            terms = revised.terms
    assert mapper.found
    assert left_deg(with_terms(WRONG, terms), TRUE) < 0.1
    source, found = mapper.calibration
    assert source is WRONG
    assert found.tobytes() == terms.tobytes()
    assert left_deg(mapper.rig, TRUE) < 0.1


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_day_begins_with_the_correction_of_the_day_before(
    yesterday: StoreSequence, localize_only: bool, tmp_path: Path
) -> None:
    kept = np.array([*np.deg2rad([-0.3, -0.3, 0.3]), 0, 0, 0, 0, 0])
    save_map(dataclasses.replace(map_of_sequence(yesterday), cameras={0: MapCamera(WRONG, kept)}), tmp_path / "map")
    folders = MapFolders(tmp_path / "map", localize_only)
    mapper = make_mapper(Config(), WRONG, NoSpans(), folders)
    other = make_mapper(Config(), turned(WRONG, (0, 0.01, 0)), NoSpans(), folders)  # another calibration
    terms, revisions = np.zeros(RIG_TERMS), list[CalibrationUpdate]()
    for keyframe in yesterday.keyframes:
        if (revised := mapper.step(replace(keyframe, rig_terms=terms)).calibration) is not None:
            revisions.append(revised)
            terms = revised.terms
        if keyframe.kf_id < 2:
            assert other.step(keyframe).calibration is None
    assert [r.why for r in revisions].count("kept") == 1
    assert (revisions[0].why, revisions[0].kf_id) == ("kept", 1)
    assert revisions[0].terms.tobytes() == kept.tobytes()
    assert left_deg(mapper.rig, TRUE) < 0.1


# -- three rendered days -----------------------------------------------------------------------------------------------

STORE = "sim:loop?size=424x400&rate=10&frames=110"
ERROR_DEG, KNOCK_DEG = (0.1, -0.1, 0.1), (0.0, 0.2, 0.0)
DAYS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Day:
    """What a camera saw, and by which rig at the end."""

    images: list[StereoImage]
    truth: Trajectory
    calibration: Rig  # that the runs get
    true: Rig


@pytest.fixture(scope="module")
def days() -> list[Day]:
    """The same way on three days; the rig is wrong from the start, and turns in the middle of the second day."""
    out: list[Day] = []
    for number in range(DAYS):
        with open_source(f"{STORE}&exchange={0.05 * number}") as source:
            assert isinstance(source, SimSource)
            assert source.ground_truth is not None
            rig, ids, images = source.rig, source.frame_ids.tolist(), list[StereoImage]()
            for frame_id in ids:
                knocked = number > 1 or (number == 1 and len(images) > len(ids) // 2)
                source.renderer.rig = turned(rig, KNOCK_DEG) if knocked else rig
                images.append(source.frame(frame_id))
            out.append(Day(images, source.ground_truth, turned(rig, ERROR_DEG), source.renderer.rig))
    return out


def drive(day: Day, config: Config, folders: MapFolders) -> tuple[InlineRun, RunRecord]:
    record = RunRecord.of(config)
    run = InlineRun(MemorySource(day.calibration, day.images, day.truth), config, [record], folders=folders)
    for image in day.images:
        run.step(image)
    run.finish()
    return run, record


def errors_m(record: RunRecord, day: Day, first: Day) -> F64:
    """(N,) of the positions in the map, whose frame is the first day's first camera."""
    mapped = record.mapped()
    assert mapped is not None
    truth, rows = poses_at(day.truth, mapped.stamp_ns)
    expected = se3.inverse(first.truth.poses[0]) @ truth
    return np.linalg.norm(mapped.poses[rows, :3, 3] - expected[:, :3, 3], axis=1)


def _extended(days: list[Day], config: Config, folder: Path) -> list[RunRecord]:
    """`run A --map-out S`, then `run B --map-in S --map-out S2` and so on."""
    out, before = list[RunRecord](), None
    for number, day in enumerate(days):
        folders = MapFolders(before, map_out=folder / str(number))
        out.append(drive(day, config, folders)[1])
        before = folders.map_out
    return out


def _updated(days: list[Day], config: Config, folder: Path) -> list[RunRecord]:
    """Each day alone, then `map update`; localized in the map of the days before."""
    del folder
    vocabulary, saved, out = configured_vocabulary(config.loop), None, list[RunRecord]()
    for day in days:
        run, record = drive(day, config, MapFolders())
        own = saved_map_of(run.map_stage.mapper, config)
        assert own is not None
        saved = own if saved is None else update(saved, own, vocabulary, config.loop, config.mapper).saved
        out.append(record)
    assert saved is not None
    assert sorted(saved.cameras) == list(range(DAYS))
    return out


def _served(days: list[Day], config: Config, folder: Path) -> list[RunRecord]:
    """As the service does: each session's part is saved and joined with the map that it began with."""
    store, out = MapStore(folder / "store", "extend", config), list[RunRecord]()
    for day in days:
        run, record = drive(day, config, store.begin())
        mapper = run.map_stage.mapper
        own = saved_map_of(mapper, config)
        assert own is not None
        save_session(own, mapper.place(), store.session)
        store.join()
        joined = store.joined(600.0)
        assert joined is not None
        assert joined.why == ""
        out.append(record)
    store.release()
    assert sorted(load_map(folder / "store").cameras) == list(range(DAYS))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("how", [_extended, _updated, _served], ids=["map-in", "map update", "serve"])
def test_three_days(days: list[Day], how: type, tmp_path: Path) -> None:
    records: list[RunRecord] = how(days, Config(), tmp_path)
    for day, record in zip(days, records, strict=True):
        assert record.tracked().all()
        corrected = with_terms(day.calibration, record.calibrations[-1].terms)
        assert left_deg(corrected, day.true) < 0.25 * left_deg(day.calibration, day.true)
        if how is not _updated:
            assert np.median(errors_m(record, day, days[0])) < 0.05


@pytest.mark.slow
def test_localizing_only_corrects_the_rig_too(days: list[Day], tmp_path: Path) -> None:
    drive(days[0], Config(), MapFolders(map_out=tmp_path / "map"))
    _, record = drive(days[2], Config(), MapFolders(tmp_path / "map", localize_only=True))
    corrected = with_terms(days[2].calibration, record.calibrations[-1].terms)
    assert left_deg(corrected, days[2].true) < 0.25 * left_deg(days[2].calibration, days[2].true)
