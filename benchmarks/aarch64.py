"""The package on 64-bit ARM: installed from wheels into an emulated Debian, its poses compared with this machine's.

    python -m benchmarks aarch64 -- [--root FOLDER] [--frames 30]

As root on x86-64 Debian with `apt-get install debootstrap qemu-user-static binfmt-support`. Makes a Debian arm64 root
(or uses the one in FOLDER again), installs this checkout's wheel there with the pinned requirements, wheels only, runs
the first frames of the bundled recording in both, and compares the positions. The compiler's instructions and with
them the last bits differ between processors; the positions must agree to a micrometre. The exit code is 1 if not.

Times in the emulated system tell nothing about a board.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from stereo_sfm.types import F64

TOP = Path(__file__).parents[1]
SUITE = "bookworm"
PACKAGES = "python3,python3-venv"
NEEDED = "debootstrap", "qemu-aarch64-static", "unshare", "mount"
HANDLER = Path("/proc/sys/fs/binfmt_misc/qemu-aarch64")  # the kernel's, for programs of the other processor
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")  # with those that this machine trusts besides
CHROOT = shutil.which("chroot") or "/usr/sbin/chroot"  # not on the path of the other system's programs
LARGEST_M = 1e-6  # between the positions of a frame on the two processors
RUN = ["--inline", "--log", "none", "-q", "--overwrite"]


def missing() -> str:
    """What this machine lacks for the comparison; '' if nothing."""
    if platform.machine() != "x86_64" or not hasattr(os, "geteuid"):
        return "an x86-64 Linux machine"
    if os.geteuid() != 0:
        return "root, for chroot"
    if lacking := [tool for tool in NEEDED if shutil.which(tool) is None]:
        return f"{', '.join(lacking)}: apt-get install debootstrap qemu-user-static binfmt-support"
    if not HANDLER.exists():
        subprocess.run(["mount", "-t", "binfmt_misc", "binfmt_misc", str(HANDLER.parent)], capture_output=True)
        subprocess.run(["update-binfmts", "--enable", HANDLER.name], capture_output=True)
    return "" if HANDLER.exists() else f"{HANDLER}: the kernel runs no programs of other processors (binfmt_misc)"


class ArmRoot:
    """A Debian arm64 system in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self) -> None:
        """Unpack and configure the system with Python, unless it is there."""
        if (self.folder / "debootstrap").exists():
            sys.exit(f"{self.folder} is not finished: remove it")
        if not (self.folder / "usr/bin/python3").exists():
            command = ["debootstrap", "--arch=arm64", "--variant=minbase", f"--include={PACKAGES}", SUITE]
            subprocess.run([*command, str(self.folder)], check=True, stdout=subprocess.DEVNULL)
        certificates = self.folder / CERTIFICATES.relative_to("/")
        certificates.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(CERTIFICATES, certificates)
        shutil.copy("/etc/resolv.conf", self.folder / "etc/resolv.conf")

    def run(self, *command: str) -> None:
        """Run a program of the system to its end, with a /proc that is gone when it ends."""
        environment = {"PATH": "/usr/bin:/bin", "HOME": "/root", "PIP_CERT": str(CERTIFICATES)}
        with_proc = ["unshare", "--mount", "sh", "-c", 'mount -t proc proc "$0/proc" && exec "$@"', str(self.folder)]
        subprocess.run([*with_proc, CHROOT, str(self.folder), *command], check=True, env=environment)

    def install(self, wheel: Path) -> None:
        """Install the package from its wheel; everything that it needs must have a wheel too."""
        for file in (wheel, TOP / "requirements.lock", TOP / "recordings/demo.mcap"):
            shutil.copy(file, self.folder / "root")
        self.run("python3", "-m", "venv", "--clear", "/root/venv")
        self.run(
            "/root/venv/bin/pip", "install", "-q", "--only-binary", ":all:", "-c", "/root/requirements.lock",
            f"/root/{wheel.name}",
        )  # fmt: skip


def built_wheel(work: Path) -> Path:
    """The wheel of this checkout."""
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(work)]
    subprocess.run([*command, str(TOP)], check=True)
    return next(work.glob("*.whl"))


def positions(folder: Path) -> F64:
    """(N, 3) positions of the odometry and then of the map, of a run's folder."""
    files = [folder / f"trajectory_{kind}.tum" for kind in ("odom", "map")]
    return np.concatenate([np.loadtxt(file, ndmin=2)[:, 1:4] for file in files])


def compare(here: F64, there: F64) -> int:
    """Print how far the positions are apart; 1 if too far."""
    if here.shape != there.shape:
        print(f"{len(here)} positions here, {len(there)} on aarch64")
        return 1
    apart = np.linalg.norm(here - there, axis=1)
    print(f"{len(here)} positions on {np.ptp(here, axis=0).max():.2f} m: at most {apart.max():.1e} m apart")
    return int(not apart.max() <= LARGEST_M)


def measure(root: ArmRoot, frames: int, work: Path) -> int:
    """Make the root, install, run and compare."""
    begin = time.monotonic()

    def done(what: str) -> None:
        print(f"{time.monotonic() - begin:6.0f} s  {what}", flush=True)

    root.make()
    done(f"Debian {SUITE} arm64 is ready")
    root.install(built_wheel(work))
    done("installed from wheels")
    limit = ["--max-frames", str(frames)]
    root.run("/root/venv/bin/stereo-sfm", "run", "/root/demo.mcap", "-o", "/root/run", *limit, *RUN)
    done(f"{frames} frames, with compilation")
    recording = str(TOP / "recordings/demo.mcap")
    command = [sys.executable, "-m", "stereo_sfm.cli", "run", recording, "-o", str(work / "run"), *limit, *RUN]
    subprocess.run(command, check=True, cwd=TOP)
    return compare(positions(work / "run"), positions(root.folder / "root/run"))


def main() -> int:
    """Compare; 1 if the positions differ or cannot be compared."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="keep the system here, and use it if it is there")
    parser.add_argument("--frames", type=int, default=30)
    args = parser.parse_args()
    if lack := missing():
        print(f"not compared, this needs {lack}", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as name:
        return measure(ArmRoot(args.root or Path(name) / "root"), args.frames, Path(name))


if __name__ == "__main__":
    sys.exit(main())
