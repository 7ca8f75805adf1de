"""What people bring: small inputs that went wrong once, each with one command and what is right.

    python benchmarks/inputs.py [--cases FOLDER] [--only WORD]

The folder (default: STEREO_SFM_CASES, or ../shared/cases beside the checkout) has the recordings and calibrations.
Printed is a line for each: PASS, REFUSED with the line that the user reads, or WRONG with the reason. A traceback, more
than three lines of refusal, and a result that is not right are WRONG. The exit code is the number of those.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from _sequences import ROOT

from stereo_sfm.calib import Rig, load_rig

TIMEOUT_S = 600  # of one command on a busy machine
REFUSAL_LINES = 3  # a refusal that a user reads


@dataclass(frozen=True)
class Outcome:
    """A finished command."""

    code: int
    text: str  # what it printed, errors included
    out: Path  # {out} of the command


Check = Callable[[Outcome], str]  # "" where the outcome is right, else the reason


@dataclass(frozen=True)
class Case:
    """Commands of `stereo-sfm` after one another, {in} being the case's file and {out} a new place."""

    file: str
    commands: tuple[str, ...]
    check: Check
    refusal: bool = True  # whether one line that refuses the input is right, too


def says(*words: str) -> Check:
    """All words are printed."""
    return lambda done: "".join(f"it does not say '{word}'" for word in words if word not in done.text)


def does_not_say(*words: str) -> Check:
    """None of the words is printed."""
    return lambda done: "".join(f"it says '{word}'" for word in words if word in done.text)


def once(word: str) -> Check:
    """Said, but not for each image."""
    return lambda done: "" if done.text.count(word) == 1 else f"'{word}' is said {done.text.count(word)} times"


def rig(right: Callable[[Rig], bool], what: str) -> Check:
    """The written calibration is right."""

    def check(done: Outcome) -> str:
        found = load_rig(done.out)
        return "" if right(found) else f"not {what}: {found.left.model}, baseline {found.baseline:.4f} m"

    return check


def model(name: str) -> Check:
    """The left lens is of a model."""
    return rig(lambda found: found.left.model == name, f"{name}")


def pair(baseline_m: float) -> Check:
    """Two cameras that far apart."""
    return rig(lambda found: abs(found.baseline - baseline_m) < 1e-5, f"a pair {1000 * baseline_m:g} mm apart")


def tilted(found: Rig) -> bool:
    """The projection of the OAK's 14 coefficients as OpenCV has it."""
    import cv2

    lens = found.left
    points = np.random.default_rng(0).uniform([-1, -0.6, 1], [1, 0.6, 1.5], (200, 3))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))[0][:, 0]
    return len(lens.distortion) == 14 and bool(np.abs(lens.project(points) - theirs).max() < 1e-9)


def passes(done: Outcome) -> str:
    """The last command's own verdict is good."""
    return "" if done.code == 0 else f"exit {done.code}: {(done.text.strip() or 'nothing').splitlines()[-1]}"


CONVERT = ("convert-calib {in} {out}.yaml",)
INFO = ("info {in}",)
CASES = (
    Case("realsense_gyro_accel.mcap", ("run {in} -o {out}",), does_not_say("rolled by -8", "rolled by −8")),
    Case("t265_plumb_bob.mcap", ("run {in} -o {out}", "eval {out} --ref {cases}/truth.tum --max-ape 0.003"), passes),
    Case("clock_from_1970.mcap", ("run {in} -o {out}",), passes, refusal=False),
    Case("header_clock_back_2s.mcap", ("record {in} -o {out}.mcap", "run {out}.mcap -o {out}"), passes, refusal=False),
    Case("camera_info_nan_P.mcap", INFO, says("/left/camera_info", " P ")),
    # That R has no rotation, although the lenses distort, may be said.
    Case("oak_tilted_14.mcap", INFO, says("left  tilted", "right tilted", "images: 3"), refusal=False),
    Case("encoding_unknown.mcap", INFO, once("bayer_rggb16")),
    # Its images were rendered without distortion: that they contradict the lens may be said.
    Case("namespace_direct.mcap", INFO, says("radtan")),
    Case("calib/da_14.json", CONVERT, rig(tilted, "OpenCV's model"), refusal=False),
    Case("calib/cv_squares.yml", CONVERT, says("warning", "baseline")),
    Case("calib/cv_fisheye_noname.yml", CONVERT, model("kannala_brandt")),
    Case("calib/t265_plumb", CONVERT, model("kannala_brandt")),
    Case("calib/names_infra1/infra1.yaml", CONVERT, pair(0.063933)),
    Case("calib/orbslam3_kb8.yaml", CONVERT, pair(0.064), refusal=False),
    Case("calib/ros_none", CONVERT, model("pinhole"), refusal=False),
    Case("calib/t265_eq5", CONVERT, model("kannala_brandt"), refusal=False),
    Case("calib/kalibr3.yaml", ("convert-calib {in} {out}.yaml --pair 0,2",), pair(0.128), refusal=False),
)  # fmt: skip
# Lines that begin with a command's name are refusals of the command line; `info` names a problem and returns 0.
REFUSALS = ("stereo-sfm ", "problem: ")


def verdict(case: Case, done: Outcome) -> tuple[str, str]:
    """PASS, REFUSED or WRONG, and the line that says why."""
    lines = [line for line in done.text.splitlines() if line.startswith(REFUSALS)]
    if "Traceback" in done.text or done.code not in (0, 2, 3, 4):
        return "WRONG", done.text.strip().splitlines()[-1] if done.text.strip() else f"exit {done.code}"
    if done.code == 2 or (lines and case.refusal):
        reason = "" if case.refusal else "refused: "
        fits = case.refusal and 1 <= len(lines) <= REFUSAL_LINES
        return "REFUSED" if fits else "WRONG", reason + (lines or ["without a line"])[0]
    reason = case.check(done)
    return ("WRONG", reason) if reason else ("PASS", "")


def run(case: Case, cases: Path) -> tuple[str, str]:
    """The verdict on one case's commands."""
    with TemporaryDirectory() as folder:
        out, text, code = Path(folder) / "out", "", 0
        for command in case.commands:
            words = [w.format(**{"in": cases / case.file, "out": out, "cases": cases}) for w in shlex.split(command)]
            try:
                done = subprocess.run(
                    [sys.executable, "-m", "stereo_sfm.cli", *words], capture_output=True, text=True, timeout=TIMEOUT_S,
                    env=os.environ | {"PYTHONPATH": str(ROOT)}, cwd=folder,
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                return "WRONG", f"'{words[0]}' did not end within {TIMEOUT_S} s"
            text, code = text + done.stdout + done.stderr, done.returncode
            if code not in (0, 3, 4):
                break
        return verdict(case, Outcome(code, text, out.with_suffix(".yaml")))


def main() -> int:
    """Print the verdicts; the number of wrong ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("STEREO_SFM_CASES") or ROOT.parent / "shared" / "cases"
    parser.add_argument("--cases", type=Path, default=Path(default), help="folder of the inputs")
    parser.add_argument("--only", default="", metavar="WORD", help="only cases whose name has this word")
    options = parser.parse_args()
    if not options.cases.is_dir():
        print(f"no cases in {options.cases}: set STEREO_SFM_CASES or give --cases", file=sys.stderr)
        return 0
    verdicts: list[str] = []
    for case in CASES:
        if options.only in case.file:
            found, line = run(case, options.cases.resolve())
            verdicts.append(found)
            print(f"{found:<8} {case.file:<32} {line}", flush=True)
    print(", ".join(f"{verdicts.count(name)} {name}" for name in ("PASS", "REFUSED", "WRONG")))
    return verdicts.count("WRONG")


if __name__ == "__main__":
    sys.exit(main())
