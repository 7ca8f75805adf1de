"""The configuration: invalid values are rejected on loading, in one line with the valid ones."""

from __future__ import annotations

import dataclasses
import logging
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm.config import REMOVED, RENAMED, Config, dump, estimator_names, explain, from_dict, load
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.mapping.pose_graph import ROBUST
from stereo_sfm.papers.extraction import TABLE as FEATURES
from stereo_sfm.papers.motion_estimator import SCALES
from stereo_sfm.presets import PRESETS
from stereo_sfm.settings import walk


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loop.correction=pose_grap", "is 'pose_grap', did you mean pose_graph?: choose one of pose_graph, averaging"),
        ("loop.robust=foo", "loop.robust is 'foo': choose one of gnc, switchable, none"),
        ("odometry.method=emr", "odometry.method is 'emr', did you mean em-r?: choose one of flow, eight-point, em-r"),
        ("features.kind=SIFT", "features.kind is 'SIFT', did you mean sift?: choose one of orb, sift, akaze"),
        ("seed=-1", "seed is -1: it must be from 0 to"),
        ("features.ratio=-1", "features.ratio is -1: it must be from 0.01 to 1"),
        ("odometry.min_inliers=-5", "odometry.min_inliers is -5: it must be from 1 to"),
        ("manhattan.every=0", "manhattan.every is 0: it must be from 1 to"),
        ("loop.gate_m=-0.1", "loop.gate_m is -0.1: it must be from 0 to"),
        ("tracker.sigma_px=nan", "tracker.sigma_px is nan"),
        ("tracker.sigma_px=inf", "tracker.sigma_px is inf"),
        ("tracker.pyramid_levels=1", "tracker.pyramid_levels is 1: it must be from 2 to 10"),
        ("tracker.max_features=1000000000", "tracker.max_features is 1000000000: it must be from 1 to 20000"),
        ("loop.min_gap=99999999999999999999", "loop.min_gap is 99999999999999999999: it must be from 0 to"),
        ("pipeline.threads=1000000", "pipeline.threads is 1000000: it must be from 1 to 256"),
        ("pipeline.ring_slots=1000000", "pipeline.ring_slots is 1000000: it must be from 1 to 1024"),
        ("pipeline.cpus.nobody=[0]", "pipeline.cpus names 'nobody': the stages are capture,"),
        ("pipeline.cpus.tracker=[100000]", "pipeline.cpus names core 100000"),
        ("tracker.max_featurs=3", "there is no tracker.max_featurs, did you mean max_features?"),
        ("treker.max_features=3", "there is no treker, did you mean tracker?"),
        ("tracker=3", "tracker is a section of settings, as tracker.max_features"),
        ("tracker.max_features=many", "tracker.max_features"),
        ("tracker.max_features=true", "tracker.max_features is True: it must be from 1 to 20000"),  # Python: 1
        ("tracker.sigma_px=true", "tracker.sigma_px is True"),
        (f"tracker.sigma_px={'9' * 400}", "tracker.sigma_px is inf"),
        (f"tracker.sigma_px=-{'9' * 400}", "tracker.sigma_px is -inf"),
        (f"tracker.max_features={'9' * 400}", "it must be from 1 to 20000"),
    ],
)
def test_invalid_values_of_settings_are_rejected(override: str, message: str) -> None:
    with pytest.raises(StereoSfmError) as error:
        load(overrides=[override])
    assert message in str(error.value) and "\n" not in str(error.value)


SETTINGS = [*walk(Config())]


@pytest.mark.parametrize(("name", "field", "value"), SETTINGS, ids=[name for name, _, _ in SETTINGS])
def test_every_setting_has_a_sentence_and_every_number_two_bounds(
    name: str, field: dataclasses.Field[Any], value: Any
) -> None:
    text = field.metadata["text"]
    assert text[0].isupper() and not text.endswith(".") and "\n" not in text
    if isinstance(value, int | float) and not isinstance(value, bool):
        least, most = field.metadata["range"]
        assert least <= value <= most and np.isfinite([least, most]).all()
    elif isinstance(value, str) and name != "loop.vocabulary":
        assert value in field.metadata["words"]


@pytest.mark.parametrize("name", [name for name, _, _ in SETTINGS])
def test_one_rule_for_names(name: str) -> None:
    """Units as suffixes, with one spelling."""
    words = name.split(".")[-1].split("_")
    assert not set(words) & {"metres", "metre", "degrees", "degree", "seconds", "pixels", "pixel"}
    if "sigma" in words:  # a standard deviation says its unit
        assert words[words.index("sigma") + 1] in ("px", "m", "s", "deg")


def words_of() -> dict[str, tuple[str, ...]]:
    """Setting -> its valid words."""
    return {name: field.metadata["words"] for name, field, _ in SETTINGS if "words" in field.metadata}


def test_every_declared_word_is_accepted() -> None:
    assert len(words_of()) == 10
    for name, words in words_of().items():
        section, key = name.split(".")
        for word in words:
            assert getattr(getattr(load(overrides=[f"{name}={word}"]), section), key) == word


def test_the_words_are_those_of_the_code_that_reads_them() -> None:
    words = {name: set(words) for name, words in words_of().items()}
    assert words["loop.robust"] == set(ROBUST)
    assert words["odometry.scale"] == set(SCALES)
    assert words["odometry.method"] == {"flow", *estimator_names()}
    assert words["features.kind"] == set(FEATURES)


def test_names_of_earlier_versions_are_accepted(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    """From a file with a line that names the new one; from the log of a run without."""
    caplog.set_level(logging.INFO, "stereo_sfm")
    logging.getLogger("stereo_sfm").propagate = True
    (tmp_path / "old.toml").write_text("[loop]\npixel_sigma = 2.5\ngate_metres = 0.7\ngrow_every = 5\n")
    config = load(tmp_path / "old.toml", ["tracker.max_error=4"])
    assert (config.loop.sigma_px, config.loop.gate_m, config.tracker.max_error_sigmas) == (2.5, 0.7, 4.0)
    told = [record.getMessage() for record in caplog.records]
    assert [line for line in told if line.startswith("configuration:")] == [
        "configuration: loop.pixel_sigma is called loop.sigma_px now",
        "configuration: loop.gate_metres is called loop.gate_m now",
        "configuration: loop.grow_every is ignored: the vocabulary does not change while it is used",
        "configuration: tracker.max_error is called tracker.max_error_sigmas now",
    ]
    caplog.clear()
    assert from_dict({"loop": {"gate_degrees": 5.0}}).loop.gate_deg == 5.0
    assert not any("gate_deg" in record.getMessage() for record in caplog.records)


def test_every_earlier_name_leads_to_a_setting() -> None:
    names = {name for name, _, _ in SETTINGS}
    assert set(RENAMED.values()) <= names and not (set(RENAMED) | set(REMOVED)) & names


def test_settings_are_few() -> None:
    """What can be derived from another setting, or what nobody needs to change, is none."""
    assert sum("range" in field.metadata for _, field, _ in SETTINGS) <= 80


def test_an_explained_configuration_has_every_sentence_and_is_read_back() -> None:
    config = load(overrides=["tracker.max_features=321", "pipeline.cpus.tracker=[0, 1]", "odometry.method=um"])
    text = explain(config)
    assert from_dict(tomllib.loads(text)) == config and from_dict(tomllib.loads(explain(Config()))) == Config()
    assert "# Points followed at once (from 1 to 20000).\nmax_features = 321\n" in text
    assert all(f"# {field.metadata['text']}" in text for _, field, _ in SETTINGS)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_applied_and_read_back_from_their_text(name: str) -> None:
    config = load(base=PRESETS[name])
    assert from_dict(tomllib.loads(dump(config))) == config
