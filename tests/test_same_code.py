"""The machine code does not depend on features beyond AVX2, and a log records the processor's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.log import topics
from stereo_sfm.log.machine import arithmetic
from stereo_sfm.log.provenance import other_conditions
from stereo_sfm.log.reader import LogReader
from stereo_sfm.same_code import CHOICE, variables

SET = ("OPENBLAS_CORETYPE", "OPENCV_CPU_DISABLE", "NPY_DISABLE_CPU_FEATURES", CHOICE)
TELL = "import json; from stereo_sfm.log.machine import arithmetic; print(json.dumps(arithmetic()))"
FRAMES = 40
AVX2 = frozenset({"sse4_2", "avx2", "fma"})


def told(code: str, **variables: str) -> dict[str, str]:
    """The machine code of a new process."""
    clean = {name: value for name, value in os.environ.items() if name not in SET}
    done = subprocess.run([sys.executable, "-c", code], env={**clean, **variables}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return json.loads(done.stdout)


def test_nothing_beyond_avx2_is_used() -> None:
    found = told(f"import stereo_sfm; {TELL}")
    assert "AVX512" not in found["opencv_dispatch"] and "SkylakeX" not in found["blas"]
    code = (
        "import stereo_sfm, json; from numpy._core._multiarray_umath import __cpu_features__ as f; print(json.dumps(f))"
    )
    assert not [name for name, used in told(code).items() if used and name in ("X86_V4", "AVX512_ICL", "AVX512_SPR")]


def test_existing_settings_are_kept() -> None:
    assert "Nehalem" in told(f"import stereo_sfm; {TELL}", OPENBLAS_CORETYPE="Nehalem")["blas"]
    late = f"import numpy, stereo_sfm, os, json; print(json.dumps({{k: os.environ.get(k, '') for k in {SET!r}}}))"
    assert [value for name, value in told(late).items() if name != CHOICE] == ["", "", ""]
    child = f"import numpy, stereo_sfm, subprocess, sys; sys.exit(subprocess.call([sys.executable, '-c', {TELL!r}]))"
    assert told(child)["blas"] == told(f"import numpy; {TELL}")["blas"]  # a child computes as its parent does


def test_processors_without_avx2_are_unchanged() -> None:
    assert variables(frozenset({"sse4_2"})) == {}
    assert variables(AVX2) == {"OPENBLAS_CORETYPE": "Haswell"}
    assert "AVX512-SKX" in variables(AVX2 | {"avx512f"})["OPENCV_CPU_DISABLE"]


def test_replay_names_other_machine_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A replay that differs and was computed with other code."""
    run = ["run", "sim:aisle?frames=6&size=212x200", "--inline", "--quiet", "--max-lost", "100", "-o"]
    assert main([*run, str(tmp_path / "a")]) == 0
    here = arithmetic()
    monkeypatch.setattr("stereo_sfm.log.provenance.arithmetic", lambda: {**here, "blas": "another"})
    again = ["replay", str(tmp_path / "a"), "--inline", "--check", "--quiet", "--set", "tracker.max_features=100"]
    assert main([*again, "-o", str(tmp_path / "b")]) == 3
    assert f"blas: {here['blas']} -> another" in capsys.readouterr().out
    with LogReader(tmp_path / "a" / "run.mcap") as a, LogReader(tmp_path / "b" / "run.mcap") as b:
        assert len(other_conditions(a, b)) == 1


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of the bundled recording: tracking, mapping, place recognition."""
    folder = tmp_path_factory.mktemp("recorded")
    run = ["run", "--inline", "--quiet", "--max-frames", str(FRAMES), "-o", str(folder / "a")]
    assert main(run) == 0
    return folder / "a"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("OPENCV_CPU_DISABLE", "AVX2,FMA3", "opencv_dispatch: "),
        ("OPENBLAS_CORETYPE", "Nehalem", "blas: "),
        ("OPENBLAS_CORETYPE", "SandyBridge", "blas: "),
    ],
)
def test_a_replay_by_other_code_is_identical_or_says_what_differs(
    name: str, value: str, named: str, recorded: Path, tmp_path: Path
) -> None:
    again = ["replay", str(recorded), "--inline", "--check", "--quiet", "-o", str(tmp_path / "b")]
    clean = {key: text for key, text in os.environ.items() if key not in SET}
    done = subprocess.run(
        [sys.executable, "-m", "stereo_sfm.cli", *again], env={**clean, name: value}, capture_output=True, text=True
    )
    with LogReader(recorded / "run.mcap") as a, LogReader(tmp_path / "b" / "run.mcap") as b:
        (condition,) = other_conditions(a, b)
        assert len(b.stamps(topics.KEYFRAME)) > 1
    assert condition.startswith(named)
    if done.returncode == 3:
        assert f"  {condition}" in done.stdout.splitlines()
    else:
        assert (done.returncode, done.stdout.strip()) == (0, "identical"), done.stderr
