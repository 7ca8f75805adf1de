"""After the warm-up no stage compiles or loads a kernel any more."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.demo import demo_recording
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.pipeline.warm_up import images, keyframes
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.flow import pose_solver
from tests.calib.test_formats import RIGS

CHILD = """
import dataclasses, itertools, sys
from numba.core.dispatcher import Dispatcher
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.config import Config
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.warm_up import warm_up_stage

with open_source(sys.argv[1]) as source:
    silent = dataclasses.replace(source.rig, readout_s=0.0)  # the run learns it
    source = MemorySource(silent, list(itertools.islice(source, 300)))  # rendered or decoded
    for stage in ("tracker", "mapper", "loop"):
        warm_up_stage(stage, Config(), source.rig)
    late, load = [], Dispatcher.compile

    def noticed(self, signature):
        late.append(self.py_func.__name__)
        return load(self, signature)

    Dispatcher.compile = noticed
    for _ in run_inline(source, Config()):
        pass
print(*sorted(set(late)))
"""
FORKED = """
import sys
import stereo_sfm.pipeline.preload
from stereo_sfm.config import Config
from stereo_sfm.pipeline.warm_up import warm_up_stage
from tests.calib.test_formats import RIGS

loaded = set(sys.modules)
warm_up_stage("loop", Config(), RIGS["ideal"])
print(*sorted(m for m in set(sys.modules) - loaded if m.startswith(("numba.cpython.", "numba.np."))))
"""
SHARED = """
import sys
from numba.core.dispatcher import Dispatcher
from stereo_sfm.config import Config
from stereo_sfm.pipeline.first_kernels import compile_share
from stereo_sfm.pipeline.warm_up import warm_up_stage
from tests.calib.test_formats import RIGS

warm_up_stage("tracker", Config(), RIGS[sys.argv[1]])
late, load = [], Dispatcher.compile
Dispatcher.compile = lambda self, signature: late.append(self.py_func.__name__) or load(self, signature)
compile_share(Config(), RIGS[sys.argv[1]])
print(*sorted(set(late)))
"""
SIMULATED = "sim:people?frames=40&size=320x200&vibration=2"
ROLLING = "sim:aisle?camera=pinhole&size=320x200&start=60&frames=60&vibration=4&readout=0.025"
# A process of some ten seconds each: the lenses of most cameras by default, the others with the slow tests.
ONE_OF_EACH = [pytest.param(name, marks=() if name in ("fisheye", "radtan") else pytest.mark.slow) for name in RIGS]


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_sent_to_a_stage_needs_no_other_kernels(name: str) -> None:
    """Kernels are compiled for read-only arrays or for others: `stereo-sfm compile` has the rig itself."""
    rig = RIGS[name]
    received = pickle.loads(pickle.dumps(rig))
    for before, after in ((rig, received), (rig.left, received.left), (rig.imu, received.imu)):
        arrays = {k: v.flags.writeable for k, v in vars(before or rig).items() if isinstance(v, np.ndarray)}
        assert arrays == {k: v.flags.writeable for k, v in vars(after or received).items() if isinstance(v, np.ndarray)}
        assert not any(arrays.values())


def test_what_numba_needs_for_kernels_is_loaded_before_stages_are_forked() -> None:
    child = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, env=dict(os.environ))
    assert child.returncode == 0, child.stderr
    assert child.stdout.split() == []


def late_kernels(source: str) -> list[str]:
    """What the stages load while the first images of a source are processed after the warm-up."""
    child = subprocess.run([sys.executable, "-c", CHILD, source], capture_output=True, text=True, env=dict(os.environ))
    assert child.returncode == 0, child.stderr
    return child.stdout.split()


@pytest.mark.parametrize(
    "source", [str(demo_recording()), f"{SIMULATED}&camera=pinhole", f"{SIMULATED}&imu=t265", ROLLING]
)
def test_nothing_is_compiled_after_the_warm_up(source: str) -> None:
    assert late_kernels(source) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["euroc_mh01", "kitti", "rgbd_dataset_freiburg1_xyz", "store_walk"])
def test_nothing_is_compiled_after_the_warm_up_of_a_real_camera(name: str, data_root: Path) -> None:
    assert late_kernels(str(data_root / name)) == []


@pytest.mark.parametrize("rig", ONE_OF_EACH)
def test_a_helper_compiles_only_what_the_tracker_needs(rig: str) -> None:
    child = subprocess.run([sys.executable, "-c", SHARED, rig], capture_output=True, text=True, env=dict(os.environ))
    assert child.returncode == 0, child.stderr
    assert child.stdout.split() == []


@pytest.mark.parametrize("rig", ONE_OF_EACH)
def test_the_last_images_of_the_warm_up_show_two_motions(rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    errors_at = pose_solver.errors_at
    monkeypatch.setattr(pose_solver, "errors_at", lambda *given: seen.append(len(given[2].rho)) or errors_at(*given))
    tracker = make_tracker(Config(), RIGS[rig])
    for image in images(RIGS[rig]):
        tracker.step(image)
    assert seen


def test_images_of_any_size_have_a_warm_up() -> None:
    camera = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
    made = keyframes(Rig(camera, camera, np.eye(4) + 0.1 * np.eye(4, k=3)))
    assert made and all(len(keyframe.point_ids) for keyframe in made)
