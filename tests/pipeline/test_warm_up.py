"""After the warm-up no stage compiles or loads a kernel any more."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.pipeline.warm_up import keyframes

CHILD = """
import sys
from numba.core.dispatcher import Dispatcher
from stereo_sfm.drivers.source import open_source
from stereo_sfm.config import Config
from stereo_sfm.demo import demo_recording
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.warm_up import warm_up_stage

with open_source(str(demo_recording())) as source:
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


def test_nothing_is_compiled_after_the_warm_up() -> None:
    child = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, env=dict(os.environ))
    assert child.returncode == 0, child.stderr
    assert child.stdout.split() == []


def test_images_of_any_size_have_a_warm_up() -> None:
    camera = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
    made = keyframes(Rig(camera, camera, np.eye(4) + 0.1 * np.eye(4, k=3)))
    assert made and all(len(keyframe.point_ids) for keyframe in made)
