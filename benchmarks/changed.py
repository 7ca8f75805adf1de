"""Real sequences backwards, mirrored, upside down, at half the rate and half the size: images nobody has looked at.

    STEREO_SFM_REAL=FOLDER STEREO_SFM_DATA=FOLDER python -m benchmarks changed -- [--only NAME]

Each pair sequence of `benchmarks real` is written to STEREO_SFM_REAL/changed as folders of images with calibration and
ground truth, which `benchmarks real` runs as further sequences. All have global shutters. IMU samples are left out.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from _real_sequences import SEQUENCES, Sequence, real_root

from stereo_sfm.calib.formats.native import write_native
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import open_source
from stereo_sfm.export.trajectories import write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64, U8, Trajectory


def flipped(camera: Camera, upside_down: bool) -> Camera:
    """A camera whose image is mirrored, or turned by half a turn."""
    tangential = {"p1": -1.0 if upside_down else 1.0, "p2": -1.0}
    signs = [tangential.get(name, 1.0) for name in camera.coefficients]
    return replace(
        camera,
        cx=camera.width - 1 - camera.cx,
        cy=camera.height - 1 - camera.cy if upside_down else camera.cy,
        distortion=tuple(d * sign for d, sign in zip(camera.distortion, signs, strict=False)),
    )


def halved(camera: Camera) -> Camera:
    """A camera whose pixels are as large as two by two of these; an odd last row or column is left out."""
    cx, cy = ((c + 0.5) / 2 - 0.5 for c in (camera.cx, camera.cy))
    size = {"width": camera.width // 2, "height": camera.height // 2}
    return replace(camera, **size, fx=camera.fx / 2, fy=camera.fy / 2, cx=cx, cy=cy)


def halved_image(image: U8) -> U8:
    """Means of two by two pixels."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(half, np.uint8)


def flip(upside_down: bool) -> F64:
    """(4, 4) from the axes of a camera to those of the flipped one, and back."""
    return np.diag([-1.0, -1.0 if upside_down else 1.0, 1.0, 1.0])


def flipped_rig(rig: Rig, upside_down: bool) -> Rig:
    """The right camera becomes the left one."""
    assert rig.right is not None
    turn = flip(upside_down)
    return Rig(
        flipped(rig.right, upside_down), flipped(rig.left, upside_down),
        turn @ se3.inverse(rig.left_T_right) @ turn, name=rig.name,
    )  # fmt: skip


def flipped_truth(truth: Trajectory, rig: Rig, upside_down: bool) -> Trajectory:
    """Of the new left camera; mirrored, the world is mirrored, too."""
    turn = flip(upside_down)
    poses = truth.poses @ rig.left_T_right @ turn
    return Trajectory(truth.stamp_ns, poses if upside_down else turn @ poses)


def write(sequence: Sequence, place: Path, out: Path, how: str) -> None:
    """One changed sequence: image folders, times.txt, rig.yaml, groundtruth.tum."""
    axes = {"mirrored": 1, "upside down": -1}  # of cv2.flip
    with open_source(str(place), place.parent / sequence.rig if sequence.rig else None) as source:
        rig, truth = source.rig, source.ground_truth
        images = [image for image in source if image.right is not None][:: 2 if how == "half the rate" else 1]
    first_ns, last_ns = images[0].stamp_ns, images[-1].stamp_ns
    for side in ("left", "right"):
        (out / side).mkdir(parents=True)
    times: list[int] = []
    for k, image in enumerate(images[::-1] if how == "backwards" else images):
        pair = [image.left, np.asarray(image.right)]
        if how in axes:
            pair = [np.asarray(cv2.flip(side, axes[how]), np.uint8) for side in pair[::-1]]
        if how == "half the size":
            pair = [halved_image(pixels) for pixels in pair]
        for side, pixels in zip(("left", "right"), pair, strict=True):
            cv2.imwrite(str(out / side / f"{k:06d}.png"), pixels)
        times.append(last_ns - image.stamp_ns if how == "backwards" else image.stamp_ns - first_ns)
    np.savetxt(out / "times.txt", np.array(times) * 1e-9, fmt="%.9f")
    if how in axes:
        changed = flipped_rig(rig, how == "upside down")
    else:
        assert rig.right is not None
        left, right = (halved(c) if how == "half the size" else c for c in (rig.left, rig.right))
        changed = Rig(left, right, rig.left_T_right, name=rig.name)
    write_native(changed, out / "rig.yaml")
    if truth is None:
        return
    if how == "backwards":
        truth = Trajectory((last_ns - truth.stamp_ns)[::-1].copy(), truth.poses[::-1].copy())
    else:
        truth = Trajectory(truth.stamp_ns - first_ns, truth.poses)
        truth = flipped_truth(truth, rig, how == "upside down") if how in axes else truth
    write_tum(out / "groundtruth.tum", truth)


def main(args: list[str] | None = None) -> int:
    """Write what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="sequences that begin so; repeat")
    options = parser.parse_args(args)
    real = real_root(None)
    if real is None:
        print("set STEREO_SFM_REAL to the folder of the real sequences", file=sys.stderr)
        return 2
    recorded = {s.name: s for s in SEQUENCES if not s.changed}
    for new in (s for s in SEQUENCES if s.changed):
        sequence, out = recorded[new.name.removesuffix(f" {new.changed}")], real / new.place
        place = sequence.path(real)
        wanted = not options.only or any(new.name.startswith(name) for name in options.only)
        if place is not None and wanted and not out.exists():
            part = out.with_suffix(".part")
            write(sequence, place, part, new.changed)
            part.rename(out)
            print(out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
