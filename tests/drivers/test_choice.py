"""What a command reads, as data: chosen in one process, opened in another."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import save_rig
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.choice import ReplayChoice, SourceChoice
from stereo_sfm.drivers.selection import Selection
from stereo_sfm.drivers.source import look_up
from stereo_sfm.errors import StereoSfmError
from tests.drivers.dataset_folders import make_images
from tests.synthetic import fisheye_rig

SPEC = "sim:aisle?size=212x200&frames=8&effects=0"


def test_a_choice_opens_the_same_source_wherever_it_is_opened() -> None:
    choice = SourceChoice.of(SPEC, None, Selection(frame_skip=3, max_frames=2))
    for one in (choice, pickle.loads(pickle.dumps(choice))):
        with one() as source:
            assert [image.frame_id for image in source] == [0, 3]
    assert choice.numbering == choice.opening(fisheye_rig()).frame_skip == 3
    assert not choice.device


def test_options_may_be_text_or_keywords() -> None:
    with SourceChoice.of("sim:aisle", size="212x200", frames=2, effects=False)() as a, open_source(SPEC) as b:
        assert a.rig.left.size == b.rig.left.size
        np.testing.assert_array_equal(next(iter(a)).left, next(iter(b)).left)


def test_a_choice_reads_the_calibration_and_makes_paths_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_source(SPEC) as source:
        rig = replace(source.rig, name="other")
    save_rig(rig, tmp_path / "rig.yaml")
    monkeypatch.chdir(tmp_path)
    choice = SourceChoice.of("rig.yaml", "rig.yaml")
    assert choice.spec == str(tmp_path / "rig.yaml")
    opening = choice.opening(fisheye_rig())
    assert choice.rig is not None and opening.rig is not None and choice.rig.name == opening.rig.name == "other"


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("pairs?fps=10", "{}/pairs?fps=10"),
        ("images:pairs", "images:{}/pairs"),
        (
            "images:pairs?fps=10&rig=a+b.yaml&left=left&right=right",
            "images:{}/pairs?fps=10&rig={}/a%20b.yaml&left=left&right=right",
        ),
        ("pairs?rig=a%20b.yaml", "{}/pairs?rig={}/a%20b.yaml"),
        ("~/pairs", "{}/pairs"),
        ("images:~/pairs", "images:{}/pairs"),
        ("odd?fps=10", "{}/odd?fps=10"),  # a folder's name
        ("sim:loop?rig=a+b.yaml&seed=2", "sim:loop?rig={}/a%20b.yaml&seed=2"),  # a scene, though a folder has its name
        ("t265:simulated", "t265:simulated"),
    ],
)
def test_the_paths_of_a_source_are_absolute(
    text: str, meant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a kind and with options, too: a log records where its images are, and is replayed elsewhere."""
    make_images(tmp_path / "pairs")
    make_images(tmp_path / "odd?fps=10")
    (tmp_path / "pairs" / "rig.yaml").rename(tmp_path / "a b.yaml")
    (tmp_path / "pairs" / "rig.yaml").write_bytes((tmp_path / "a b.yaml").read_bytes())
    for name in ("loop", "simulated"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    choice = SourceChoice.of(text)
    assert choice.spec == meant.replace("{}", str(tmp_path))
    assert look_up(choice.spec).kind == look_up(text).kind
    (tmp_path / "else").mkdir()
    monkeypatch.chdir(tmp_path / "else")
    if "pairs" in text or "odd" in text:
        with choice() as source:
            assert source.frame_count == 12
            if "fps=10" in text and "odd" not in text:
                assert [image.stamp_ns for image in islice(source, 2)] == [0, 100_000_000]


def test_a_place_with_a_question_mark_is_left_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_images(tmp_path / "why?" / "pairs")
    monkeypatch.chdir(tmp_path / "why?")
    with SourceChoice.of("pairs?fps=10")() as source:
        assert source.frame_count == 12


def test_a_choice_rectifies_and_replays() -> None:
    choice = ReplayChoice(SPEC, rectify="wide", frame_ids=(1, 4, 5), recorded_skip=2)
    with choice() as source:
        assert source.rig.left.model != "kannala_brandt"
        assert [image.frame_id for image in source] == [1, 4, 5]
    opening = choice.opening(fisheye_rig())
    assert opening.rectify == "wide" and opening.frame_skip == 2


def test_what_is_read_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    choice = SourceChoice.of(f"images:{tmp_path}?fps=10")
    choice.refuse_to_overwrite(None)
    choice.refuse_to_overwrite(tmp_path / "new")
    with pytest.raises(StereoSfmError, match="choose another -o"):
        choice.refuse_to_overwrite(tmp_path)


def test_an_unknown_rectification_is_an_error() -> None:
    with pytest.raises(StereoSfmError, match="unknown rectification 'widest'"):
        SourceChoice.of(SPEC, rectify="widest")
