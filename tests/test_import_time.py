"""`import stereo_sfm` and `--help` are instant, because heavy libraries are imported where they are used."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from stereo_sfm.cli import COMMANDS

HEAVY = ("numpy", "cv2", "numba", "scipy", "gtsam", "rerun", "mcap", "matplotlib", "rich", "depthai", "google.protobuf")
LIMIT_S = 0.5


def fresh(code: str) -> str:
    """What a fresh interpreter prints."""
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize(
    "code",
    ["import stereo_sfm", "import stereo_sfm.cli as c\ntry: c.main(['--help'])\nexcept SystemExit: pass"],
)
def test_fast_and_without_heavy_imports(code: str) -> None:
    loaded = fresh(f"{code}\nimport sys, time\nprint(time.process_time(), *[m for m in {HEAVY} if m in sys.modules])")
    seconds, *heavy = loaded.strip().splitlines()[-1].split()
    assert not heavy
    assert float(seconds) < LIMIT_S  # of the processor: on a busy machine the clock on the wall says nothing


def test_help_of_every_command_imports_no_heavy_library() -> None:
    code = (
        "import sys, stereo_sfm.cli as c\n"
        "for name in c.COMMANDS:\n"
        "    try: c.main([name, '--help'])\n"
        "    except SystemExit as stop: assert stop.code == 0, name\n"
        f"    print('loaded', name, *[m for m in {HEAVY} if m in sys.modules])"
    )
    lines = [line.split() for line in fresh(code).splitlines() if line.startswith("loaded ")]
    assert lines == [["loaded", name] for name in COMMANDS]


def test_every_public_name_can_be_had() -> None:
    import stereo_sfm

    assert all(getattr(stereo_sfm, name) is not None for name in stereo_sfm.__all__)
    assert set(stereo_sfm.__all__) <= set(dir(stereo_sfm))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = stereo_sfm.nothing


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_closed_pipe_is_not_an_error(unbuffered: str) -> None:
    """As `| head -1`, whether the output is buffered or not."""
    command = [sys.executable, "-c", "import sys, stereo_sfm.cli as c; sys.exit(c.main())", "config", "dump"]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, text=True, bufsize=1
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    errors = process.stderr.read()
    assert (process.wait(), errors) == (0, "")
