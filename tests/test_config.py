"""The configuration: what a field does not take is refused when it is loaded, in one line that says what it takes."""

from __future__ import annotations

import dataclasses
import tomllib
from typing import Any

import pytest

from stereo_sfm.config import Config, dump, from_dict, load
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.mapping.pose_graph import ROBUST
from stereo_sfm.presets import PRESETS
from stereo_sfm.tracking.features.step_scale import SCALES


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("loop.correction=foo", "loop.correction is 'foo': choose one of pose_graph, averaging"),
        ("loop.robust=foo", "choose one of gnc, switchable, none"),
        ("loop.reference=foo", "choose one of weakest, best"),
        ("mapper.association=foo", "choose one of map, tracks, previous"),
        ("features.stereo_check=foo", "choose one of rig, ransac"),
        ("odometry.reference=foo", "choose one of frame, keyframe"),
        ("odometry.scale=foo", "choose one of stereo, unit, ground-truth"),
        ("seed=-1", "seed is -1: it must be at least 0"),
        ("features.ratio=-1", "features.ratio is -1: it must be above 0"),
        ("odometry.min_inliers=-5", "odometry.min_inliers is -5: it must be above 0"),
        ("manhattan.every=0", "manhattan.every is 0: it must be above 0"),
        ("loop.gate_metres=-0.1", "loop.gate_metres is -0.1: it must be at least 0"),
        ("tracker.sigma_px=nan", "tracker.sigma_px is nan"),
        ("tracker.pyramid_levels=1", "tracker.pyramid_levels is 1: it must be from 2 to 10"),
        ("tracker.min_features=0", "tracker.min_features is 0: it must be from 3 to"),
        ("loop.relocalize_keyframes=0", "loop.relocalize_keyframes is 0: it must be above 0"),
        ("tracker.max_features=1000000000", "tracker.max_features is 1000000000: it must be from 1 to 20000"),
        ("loop.min_gap=99999999999999999999", "loop.min_gap is 99999999999999999999: it is too large"),
        ("pipeline.cpus.nobody=[0]", "pipeline.cpus names 'nobody': the stages are capture,"),
    ],
)
def test_what_a_field_does_not_take_is_refused(override: str, said: str) -> None:
    with pytest.raises(StereoSfmError) as error:
        load(overrides=[override])
    assert said in str(error.value) and "\n" not in str(error.value)


def fields_with(key: str) -> list[tuple[str, str, Any]]:
    """Section, field and what its metadata says under a key."""
    sections = [f for f in dataclasses.fields(Config) if dataclasses.is_dataclass(getattr(Config(), f.name))]
    return [
        (s.name, f.name, f.metadata[key])
        for s in sections
        for f in dataclasses.fields(getattr(Config(), s.name))
        if key in f.metadata
    ]


def test_every_declared_word_is_taken() -> None:
    declared = fields_with("words")
    assert len(declared) == 7
    for section, name, words in declared:
        for word in words:
            assert getattr(getattr(load(overrides=[f"{section}.{name}={word}"]), section), name) == word


def test_the_words_are_those_of_the_code_that_reads_them() -> None:
    words = {f"{section}.{name}": set(words) for section, name, words in fields_with("words")}
    assert words["loop.robust"] == set(ROBUST)
    assert words["odometry.scale"] == set(SCALES)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_taken_and_come_back_from_their_text(name: str) -> None:
    config = load(base=PRESETS[name])
    assert from_dict(tomllib.loads(dump(config))) == config
