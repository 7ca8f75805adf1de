"""Every real sequence at hand, default and with each automatic thing off, from several starts: is default the best?

    STEREO_SFM_REAL=FOLDER STEREO_SFM_DATA=FOLDER python benchmarks/real.py
    python benchmarks/real.py --only kitti --starts 3 --switch default --switch self-calibration
    python benchmarks/real.py --against main~20        the same with an earlier commit, and the paired differences
    python benchmarks/real.py --table                  only the table of what is stored

A run is a process of its own: one that crashes is a row. Its result is stored under STORE, by the code that computed it
(the contents of the package in git, with changes that are not committed), sequence, switch and start. What is there is
not run again, so an interrupted benchmark goes on, and commits with the same code share results. `--store` names a
folder that several checkouts may share.

The sequences, what must hold of them and how they are laid out is in `_real_sequences.py`. A start is the sequence from
some frame on; `--starts N` takes the first N of each. What did nothing in the default run is not switched off in a run
of its own: the result is the same. Switches: default, self-calibration, steps (sudden changes of the rig), people
(motions other than the camera's), inertial, side views, recovery, loops. `--steps` also runs sequences whose right
camera turns by 0.1 to 0.5 degrees in the middle (right images warped), so that nothing is won by not looking.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from _sequences import ROOT, data_root, one_thread

one_thread()

from _real_inject import found_after_s
from _real_measure import first_stamp, measured, still_m, truth_of
from _real_run import NO_SWITCH, OPTIONS, STEPS
from _real_sequences import FOLDER, SEQUENCES, Sequence, real_root
from _real_table import markdown

from stereo_sfm.same_code import CHOICE

PACKAGES, SIMULATOR = ("stereo_sfm", "drivers", "calib"), "drivers/sim"
DECIDING = (*PACKAGES, f":!{SIMULATOR}")  # files that decide the results of real sequences
RUNNER = Path(__file__).with_name("_real_run.py")
LONGEST_S = 3600.0  # of a run: then it hangs
STOPPED = (130, -2, -15)  # exit codes of a run that somebody stopped: it is run again
STEREO_ONLY = ("steps", "side views")


@dataclass(frozen=True)
class Code:
    """A version of the package."""

    root: Path
    key: str  # of its contents
    label: str


@dataclass(frozen=True)
class Job:
    """One run."""

    code: Code
    sequence: Sequence
    switch: str
    begin_s: float

    def stored(self, store: Path) -> Path:
        """Where its result is."""
        return store / self.code.key / self.sequence.name / self.switch.replace(" ", "-") / f"{self.begin_s:g}.json"


def git(*args: str, root: Path = ROOT) -> str:
    """Output of git."""
    return subprocess.run(["git", "-C", str(root), *args], check=True, capture_output=True, text=True).stdout.strip()


def code_here() -> Code:
    """The package of this checkout, with what is not committed."""
    commit = git("rev-parse", "--short", "HEAD")
    changed = git("diff", "HEAD", "--", *DECIDING)
    for name in git("ls-files", "--others", "--exclude-standard", "--", *DECIDING).splitlines():
        changed += name + hashlib.sha256((ROOT / name).read_bytes()).hexdigest()
    return Code(ROOT, _key("HEAD", changed), commit + ("+changes" if changed else ""))


def code_of(commit: str, store: Path) -> Code:
    """The package of a commit, unpacked in the store, where it keeps its compiled kernels."""
    key = _key(commit)
    folder = store.resolve() / key / "code"
    if not folder.is_dir():
        part = folder.with_suffix(f".{os.getpid()}.part")
        part.mkdir(parents=True)
        command = ["git", "-C", str(ROOT), "archive", commit, *PACKAGES, "recordings"]
        archive = subprocess.run(command, check=True, capture_output=True)
        subprocess.run(["tar", "x", "-C", str(part)], input=archive.stdout, check=True)
        part.replace(folder)
    return Code(folder, key, git("rev-parse", "--short", commit))


def _key(commit: str, changed: str = "") -> str:
    files = "\n".join(
        line for line in git("ls-tree", "-r", commit, "--", *PACKAGES).splitlines() if f"\t{SIMULATOR}/" not in line
    )
    return hashlib.sha256((files + changed).encode()).hexdigest()[:12]


def environment(code: Code) -> dict[str, str]:
    """For a process that runs this code, on one thread, with the machine code that it chooses itself."""
    inherited = {name: value for name, value in os.environ.items() if name != CHOICE}
    return {**inherited, "PYTHONPATH": str(code.root)}


def compile_kernels(code: Code) -> None:
    """So that no run's processor time has it."""
    command = [sys.executable, "-m", "stereo_sfm.cli", "compile", "-q"]
    subprocess.run(command, env=environment(code), cwd=code.root, capture_output=True, check=False)  # if it has that


def result_of(job: Job, place: Path, rig: Path | None) -> dict[str, Any]:
    """Run a job and measure what it reached; what went wrong is in `error`."""
    with tempfile.TemporaryDirectory(prefix="stereo_sfm_real_") as scratch:
        folder, usage = Path(scratch) / "run", Path(scratch) / "usage.json"
        options = [
            "--inline",
            "--log",
            "none",
            "-q",
            "--max-lost",
            "100",
            "-o",
            str(folder),
            "--start",
            f"{job.begin_s}",
        ]
        options += ["--duration", f"{job.sequence.duration_s}"] if job.sequence.duration_s else []
        options += [] if rig is None else ["--rig", str(rig)]
        command = [sys.executable, str(RUNNER), job.switch, str(usage), "run", str(place), *options]
        begin, out = time.monotonic(), dict[str, Any](error="", begin_s=job.begin_s, commit=job.code.label)
        try:
            done = subprocess.run(
                command, env=environment(job.code), capture_output=True, text=True, errors="replace", timeout=LONGEST_S
            )
            code, said = done.returncode, done.stderr.strip().splitlines()
        except subprocess.TimeoutExpired:
            code, said = -1, [f"not finished after {LONGEST_S:g} s"]
        out |= {"exit": code, "wall_s": time.monotonic() - begin}
        if code == NO_SWITCH:
            return out | {"error": said[-1] if said else "no switch", "absent": True}
        truth = truth_of(place, rig)
        out["still_m"] = still_m(truth, job.begin_s, job.sequence.duration_s, first_stamp(place, rig))
        if code:
            out["error"] = said[-1] if said else f"exit code {code}"
        if (folder / "stats.json").is_file():
            out |= measured(folder, job.sequence, truth)
        if usage.is_file():
            out |= json.loads(usage.read_text("utf-8"))
        if "injected_s" in out and "changes" in out:
            out["found_after_s"] = found_after_s(job.switch, out["changes"], out["injected_s"] - job.begin_s)
        return out


def idle(switch: str, default: dict[str, Any]) -> bool:
    """Whether what a switch turns off did nothing in the default run (a result): the run without it is the same."""
    nothing = {"recovery": default.get("not_ok"), "steps": default.get("suspected")}
    return not default["error"] and nothing.get(switch, 1) == 0


def perform(job: Job, store: Path, real: Path | None) -> dict[str, Any]:
    """The stored result of a job; it is run if there is none."""
    path, place = job.stored(store), job.sequence.path(real)
    if path.is_file():
        return json.loads(path.read_text("utf-8"))
    assert place is not None
    default = replace(job, switch="default").stored(store)
    if default.is_file() and idle(job.switch, json.loads(default.read_text("utf-8"))):
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(default, path)
        return json.loads(path.read_text("utf-8"))
    result = result_of(job, place.resolve(), place.parent / job.sequence.rig if job.sequence.rig else None)
    if result["exit"] in STOPPED:
        return result
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(result, indent=1), encoding="utf-8")
    part.replace(path)
    return result


def jobs_of(codes: list[Code], sequences: list[Sequence], switches: list[str], starts: int | None) -> list[Job]:
    """What is to be run: the first start of everything, then the second."""
    wanted = [
        (k, Job(code, sequence, switch, begin_s))
        for sequence in sequences
        for switch in switches
        if not (switch == "inertial" and sequence.kind != "inertial")
        and not (switch in STEPS and not sequence.long)
        and not (switch in STEREO_ONLY and sequence.kind == "depth")
        for k, begin_s in enumerate(sequence.begins(starts))
        for code in codes
    ]
    return [job for _, job in sorted(wanted, key=lambda x: x[0])]


def machine() -> dict[str, Any]:
    """On what the results were computed."""
    import cv2
    import numba
    import numpy as np

    versions = {"python": platform.python_version(), "numpy": np.__version__, "opencv": cv2.__version__}
    return {**versions, "numba": numba.__version__, "machine": platform.machine(), "system": platform.platform()}


def main() -> int:
    """Run what is missing, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, help=f"folder of the laid-out sequences (default: {FOLDER})")
    parser.add_argument("--store", type=Path, default=ROOT / "runs" / "real", help="results (default: runs/real)")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="sequences that begin so; repeat")
    parser.add_argument("--switch", action="append", choices=list(OPTIONS), help="only these; repeat")
    parser.add_argument("--steps", action="store_true", help="besides, turn right cameras: is that noticed?")
    parser.add_argument("--starts", type=int, help="at most so many of each sequence")
    parser.add_argument("--against", metavar="COMMIT", help="an earlier commit, run beside this one")
    parser.add_argument("--jobs", type=int, default=1, help="runs at once")
    parser.add_argument("--table", action="store_true", help="run nothing, show what is stored")
    args = parser.parse_args()
    real = real_root(args.real)
    sequences = [
        s for s in SEQUENCES if s.path(real) and (not args.only or any(s.name.startswith(o) for o in args.only))
    ]
    if not sequences:
        print(f"no real sequence at hand: set {FOLDER} and STEREO_SFM_DATA to their folders", file=sys.stderr)
        return 2
    if data_root() is None or real is None:
        print(f"not all sequences are at hand: set {FOLDER} and STEREO_SFM_DATA", file=sys.stderr)
    codes = [code_here()] + ([code_of(args.against, args.store)] if args.against else [])
    switches = [*(args.switch or OPTIONS), *(STEPS if args.steps else ())]
    jobs = jobs_of(codes, sequences, switches, args.starts)
    missing = [job for job in jobs if not job.stored(args.store).is_file()]
    if not args.table:
        for code in {job.code.key: job.code for job in missing}.values():
            compile_kernels(code)
        with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
            for job, result in zip(missing, pool.map(lambda j: perform(j, args.store, real), missing), strict=True):
                print(_line(job, result), file=sys.stderr, flush=True)
    results = [(job, perform(job, args.store, real)) for job in jobs if job.stored(args.store).is_file()]
    report = {
        "codes": [{"label": c.label, "key": c.key} for c in codes],
        **machine(),
        "runs": [{**r, "code": j.code.key, "sequence": j.sequence.name, "switch": j.switch} for j, r in results],
    }
    (args.store / codes[0].key).mkdir(parents=True, exist_ok=True)
    (args.store / codes[0].key / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
    table = markdown(sequences, [c.key for c in codes], [c.label for c in codes], report["runs"])
    (args.store / codes[0].key / "report.md").write_text(table + "\n", encoding="utf-8")
    print(table)
    return 0


def _line(job: Job, result: dict[str, Any]) -> str:
    """Of a run that has just ended."""
    ate, frames = result.get("ate_m"), result.get("frames", 0)
    told = f"ATE {ate:.4f} m, " if ate is not None else ""
    angle = result.get("angle_error_deg")
    told += f"angle {angle:+.3f} deg, " if angle is not None else ""
    told += (
        f"lost {result['lost']}/{frames}, {result['corrections']} corrections, {result['steps']} steps"
        if frames
        else ""
    )
    return f"{job.code.label} {job.sequence.name} [{job.switch}] from {job.begin_s:g} s: {told} {result['error']}"


if __name__ == "__main__":
    sys.exit(main())
