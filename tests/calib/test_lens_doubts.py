"""Numbers that contradict themselves: a fisheye under another name, lengths that are not metres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import Rig, load_rig, save_rig
from stereo_sfm.calib.lens_doubts import believable, doubts, fisheye_in_disguise
from stereo_sfm.cli import main
from stereo_sfm.drivers.sim.rigs import CAMERAS
from stereo_sfm.drivers.tum_rgbd.source import INTRINSICS
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import KannalaBrandt, Pinhole, RadTan
from tests.synthetic import fisheye_rig

T265 = (-0.0061, 0.0452, -0.0426, 0.0078)


def far(rig: Rig, factor: float) -> Rig:
    transform = rig.left_T_right.copy()
    transform[:3, 3] *= factor
    return replace(rig, left_T_right=transform)


def test_a_fisheyes_coefficients_are_no_tangential_distortion() -> None:
    wide = RadTan(848, 800, 286.1, 286.2, 417.2, 399.1, T265)
    assert fisheye_in_disguise(wide)
    other = replace(wide, distortion=(-0.005, 0.03, -0.01, 0.002))  # would pass alone: a pair is of one kind
    assert all(isinstance(lens, KannalaBrandt) for lens in believable([other, wide], "a file"))
    for lens in (
        RadTan(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05)),
        RadTan(640, 480, *INTRINSICS["freiburg1"][:4], INTRINSICS["freiburg1"][4:]),
        RadTan(1280, 800, 430.0, 430.0, 640.0, 400.0, (-0.3, 0.1, 0.004, -0.003)),  # 112 degrees, one of tilt
        replace(wide, distortion=(*T265, 0.01)),  # five coefficients are no fisheye's
    ):
        assert believable([lens], "a file") == [lens]


def test_baselines_in_other_units_are_doubted() -> None:
    for rig in (CAMERAS[name]() for name in CAMERAS):
        assert doubts(rig) == []
        assert "overlap by half only from" in doubts(far(rig, 100))[0]  # centimetres
        assert "is unusual" in doubts(far(rig, 1 / 0.025))[0]  # squares of 25 mm
        assert "is unusual" in doubts(far(rig, 1e-2))[0]
        assert "is unusual" in doubts(far(rig, 10))[0]
        assert "is unusual" in doubts(far(rig, 0.1))[0]
    kitti = Pinhole(1241, 376, 718.856, 718.856, 607.2, 185.2)
    transform = np.eye(4)
    transform[0, 3] = 0.537
    assert doubts(Rig(kitti, kitti, transform)) == []
    transform = transform.copy()
    transform[0, 3] = -0.537
    assert "to the left of the left one" in doubts(Rig(kitti, kitti, transform))[0]


@pytest.mark.parametrize("name", ["opencv", "ros", "foxglove"])
def test_convert_calib_takes_the_unit_and_the_lens(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, file = fisheye_rig(), tmp_path / ("squares" if name == "ros" else "squares.yml")
    save_rig(far(rig, 40), file, name)
    out = tmp_path / "out.yaml"
    assert main(["convert-calib", str(file), str(out), "--from", name, "--overwrite"]) == 0
    said = capsys.readouterr().err
    assert "a baseline of 2560" in said and "--unit" in said
    args = ["convert-calib", str(file), str(out), "--from", name, "--overwrite", "--unit", "0.025"]
    assert main(args) == 0
    assert not capsys.readouterr().err and load_rig(out).baseline == pytest.approx(0.064, abs=1e-5)
    assert main([*args, "--lens", "plumb_bob"]) == 0
    assert load_rig(out).left.model == "radtan" and not capsys.readouterr().err
    assert main([*args[:-1], "cubit"]) == 2
    assert "--unit one of mm, cm, m, in or its length in metres" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["kalibr", "euroc", "basalt"])
def test_other_formats_take_the_unit(tmp_path: Path, name: str) -> None:
    rig, file = fisheye_rig(), tmp_path / ("folder" if name == "euroc" else "inches.json")
    save_rig(far(rig, 1 / 0.0254), file, name)
    assert load_rig(file, name, unit=0.0254).baseline == pytest.approx(rig.baseline, abs=1e-9)


def test_millimetres_name_the_file_and_the_option(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    sizes = "Camera.width: 640\nCamera.height: 480\n"
    file.write_text(f"{sizes}Camera.fx: 500.\nCamera.fy: 500.\nCamera.cx: 320.\nCamera.cy: 240.\nCamera.bf: 50000.\n")
    with pytest.raises(StereoSfmError, match=r"settings.yaml: .*baseline of 100 m.*--unit mm"):
        load_rig(file)
    assert load_rig(file, unit=1e-3).baseline == pytest.approx(0.1)


def test_options_that_a_format_has_no_use_for(tmp_path: Path) -> None:
    save_rig(fisheye_rig(), tmp_path / "rig.yaml")
    with pytest.raises(StereoSfmError, match="format rig is read with no options, not with unit"):
        load_rig(tmp_path / "rig.yaml", unit=0.01)
