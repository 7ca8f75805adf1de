"""Drivers are plugins: their list, their descriptions, and the choice of a source's driver."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from stereo_sfm import drivers
from stereo_sfm.drivers import open_source, registry
from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, described, grouped
from stereo_sfm.drivers.source import is_device, look_up, path_of
from stereo_sfm.errors import StereoSfmError
from tests.drivers.dataset_folders import make_euroc, make_images, make_kitti

ROOT = Path(__file__).parents[2]


def test_ours_are_declared_where_those_of_others_are() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(project["entry-points"][registry.GROUP]) <= set(registry.kinds())
    packages = {p.parent.name for p in (ROOT / "drivers").glob("*/__init__.py") if "Driver(" in p.read_text()}
    entries = project["entry-points"][registry.GROUP].values()
    values = {v.split(":")[0].removeprefix("stereo_sfm.drivers.") for v in entries}
    assert packages == values


@pytest.mark.parametrize("kind", registry.kinds())
def test_a_driver_describes_itself(kind: str) -> None:
    found = registry.driver(kind)
    assert found.summary and found.place.isupper()
    assert is_dataclass(found.options) and issubclass(found.options, SourceOptions) and found.options.__doc__
    helps = list(described(found.options))
    assert len(helps) == len(fields(found.options)) and all(h.doc for h in helps)
    names = [name for group in found.options.GROUPS.values() for name in group]
    assert len(names) == len(set(names)) and set(names) <= {f.name for f in fields(found.options)}
    assert sum(len(group) for _, group in grouped(found.options)) == len(helps)
    place = {"sim": "loop", "video": "drive.mp4"}.get(kind, "")
    assert found.options() == look_up(f"{kind}:{place}").options


def test_listing_the_drivers_imports_no_heavy_library() -> None:
    heavy = ("numpy", "cv2", "numba", "depthai", "usb", "mcap", "calib")
    code = f"import sys\nfrom drivers import registry\nprint(len(list(registry.drivers())))\nprint([m for m in {heavy} if m in sys.modules])"  # noqa: E501
    lines = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split("\n")
    assert int(lines[0]) == len(registry.kinds()) and lines[1] == "[]"


def test_a_typo_is_an_error_before_heavy_imports() -> None:
    code = (
        "import sys\nfrom drivers import open_source\nfrom stereo_sfm.errors import StereoSfmError\n"
        "try: open_source('sim:aile')\nexcept StereoSfmError as error: print(error)\n"
        "print('numba' in sys.modules, 'cv2' in sys.modules)"
    )
    message = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "unknown scene 'aile', did you mean aisle?" in message and "False False" in message


def test_the_scenes_that_can_be_named_are_those_that_there_are() -> None:
    from stereo_sfm.drivers import sim
    from stereo_sfm.drivers.sim.scenes import MARKET, SCENES

    assert {*SCENES, MARKET} == set(sim.SCENES) and len(sim.SCENES) == len(SCENES) + 1


def test_text_that_names_a_source() -> None:
    for spec in ("oak?fps=20", "oak:?fps=20"):
        named = look_up(spec)
        assert (named.kind, named.place, named.options.fps) == ("oak", "", 20.0)  # type: ignore[attr-defined]
    named = look_up("sim:aisle?camera=pinhole&seed=3", seed=4)
    assert (named.place, named.options.camera, named.options.seed) == ("aisle", "pinhole", 4)  # type: ignore[attr-defined]
    assert is_device("t265") and is_device("oak:1?fps=3") and not is_device("sim:loop") and not is_device("no/such")
    assert path_of("images:a/b?fps=10") == Path("a/b") and path_of("a/b") == Path("a/b")


def test_options_of_the_simulated_t265_are_not_the_cameras() -> None:
    with pytest.raises(StereoSfmError, match="option faults is only valid for t265:simulated"):
        open_source("t265?faults=unplug")


def test_an_unknown_source_gets_a_guess() -> None:
    with pytest.raises(StereoSfmError, match=r"unknown source 'sin:loop', did you mean sim\?"):
        open_source("sin:loop")
    with pytest.raises(StereoSfmError, match="no such file or folder: a/b"):
        open_source("a/b")


def _register(monkeypatch: pytest.MonkeyPatch, **found: Driver[SourceOptions]) -> None:
    monkeypatch.setattr(registry, "kinds", lambda: tuple(found))
    monkeypatch.setattr(registry, "driver", found.__getitem__)


def test_the_driver_that_is_surest_of_a_folder_opens_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def sure(certainty: Certainty) -> Driver[SourceOptions]:
        return Driver("x", "X", SourceOptions, lambda *_: None, recognise=lambda path: certainty)  # type: ignore[arg-type,return-value]

    _register(monkeypatch, a=sure(Certainty.PERHAPS), b=sure(Certainty.MARKED), c=sure(Certainty.LAYOUT))
    assert registry.recognise(tmp_path) == "b"
    _register(monkeypatch, a=sure(Certainty.NO))
    with pytest.raises(StereoSfmError, match="is not a known kind of dataset"):
        registry.recognise(tmp_path)


def test_a_bug_of_a_driver_is_not_a_user_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(place: str, options: SourceOptions) -> drivers.Source:
        raise TypeError("open() takes 1 argument")

    _register(monkeypatch, bad=Driver("x", "X", SourceOptions, broken))
    with pytest.raises(TypeError, match="takes 1 argument"):
        open_source("bad:1")


def test_a_broken_package_hides_no_other_driver(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    entries = {
        "broken": EntryPoint("broken", "no.such.module:DRIVER", registry.GROUP),
        "else": EntryPoint("else", "stereo_sfm.drivers.driver:Certainty", registry.GROUP),
        "sim": EntryPoint("sim", "stereo_sfm.drivers.sim:DRIVER", registry.GROUP),
    }
    monkeypatch.setattr(registry, "_found", lambda: entries)
    registry.driver.cache_clear()
    try:
        assert [kind for kind, _ in registry.drivers()] == ["sim"]
        assert "'broken' (no.such.module:DRIVER) cannot be loaded" in caplog.text
        assert "'else' (stereo_sfm.drivers.driver:Certainty) is not a stereo_sfm.drivers.driver.Driver" in caplog.text
    finally:
        registry.driver.cache_clear()


def _said(path: Path) -> str:
    with pytest.raises(StereoSfmError, match="is not a known kind of dataset") as error:
        registry.recognise(path)
    assert len(str(error.value)) < 220 + 3 * len(str(path))
    return str(error.value)


@pytest.mark.parametrize("make", [make_images, make_euroc, make_kitti])
def test_one_of_two_cameras_leads_to_the_folder_above(make: Callable[[Path], Path], tmp_path: Path) -> None:
    root = make(tmp_path / "data")
    for folder in {path.parent for path in root.rglob("*.png")}:
        assert "did you mean the folder above, " in _said(folder)
        above = Path(_said(folder).rpartition("above, ")[2].partition("?")[0])
        assert root in (above, *above.parents) and registry.recognise(above)


def test_what_is_no_dataset_is_told_what_it_is(tmp_path: Path) -> None:
    (tmp_path / "empty" / "left").mkdir(parents=True)
    assert "there are no images in it" in _said(tmp_path / "empty")
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "map.json").touch()
    assert f"but a map: 'stereo-sfm map info {tmp_path / 'map'}'" in _said(tmp_path / "map")


def test_two_recordings_are_no_parts_of_a_bag(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).touch()
    with pytest.raises(StereoSfmError, match=f"name one, such as {tmp_path}/a.mcap"):
        open_source(tmp_path)
