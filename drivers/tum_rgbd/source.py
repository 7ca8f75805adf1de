"""TUM RGB-D folders: rgb.txt, depth.txt, groundtruth.txt (Sturm et al., IROS 2012).

The depth images are registered to the colour images including lens distortion: depth pixel
(u, v) belongs to colour pixel (u, v). The right camera is virtual: same lens, `VIRTUAL_BASELINE` to the right.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, by_stamp, folder_of, need
from stereo_sfm.drivers.ground_truth import read_tum, stamp_from_seconds
from stereo_sfm.drivers.image_lists import pair_by_stamp
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.drivers.tum_rgbd import TumRgbdOptions
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import RadTan

log = logging.getLogger("stereo_sfm")

NEAREST_M = 0.2  # depth cameras see nothing nearer, and hold on to a few stray pixels
MAX_SKEW_NS = 20_000_000  # colour and depth within 20 ms, as in the benchmark's tools
READOUT_S = 0.028  # of these cameras' rolling shutter, as Kerl et al. (ICCV 2015) model it
VIRTUAL_BASELINE = 0.08  # metres, close to the structured-light baseline of the sensor

# fx fy cx cy, k1 k2 p1 p2 k3 of the colour cameras, from the benchmark's calibration page
INTRINSICS: dict[str, tuple[float, ...]] = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "freiburg3": (535.433105, 539.212524, 320.106653, 247.632132, 0.0, 0.0, 0.0, 0.0, 0.0),
}


def open_tum_rgbd(path: str, options: TumRgbdOptions) -> FolderSource:
    """Open a TUM RGB-D folder; its name determines which of the three cameras it is from, else a rig file is needed."""
    folder = folder_of("tum_rgbd", path)
    label = folder.resolve().name
    colour = _read_listing(need(folder / "rgb.txt", "colour image list"))
    depth = _read_listing(need(folder / "depth.txt", "depth image list"))
    pairs = pair_by_stamp([s for s, _ in colour], [s for s, _ in depth], MAX_SKEW_NS)
    if len(pairs) < len(colour):
        log.warning(
            "tum_rgbd:%s: %d of %d colour images have no depth image", label, len(colour) - len(pairs), len(colour)
        )
    frames = by_stamp(FrameFiles(colour[i][0], colour[i][1], depth=depth[j][1]) for i, j in pairs)
    truth = folder / "groundtruth.txt"
    source = FolderSource(
        f"tum_rgbd:{label}",
        with_virtual_camera(chosen_rig(options.rig, lambda: _own_rig(folder, label))),
        frames,
        read_tum(truth) if truth.is_file() else None,
        options.depth_scale,
    )
    _check_unit(source)
    return source


def _check_unit(source: FolderSource) -> None:
    """A warning where the first depths are nearer than such a camera sees: most likely they are millimetres."""
    depth = next((image.depth for image in source.at([0]) if image.depth is not None), None)
    known = depth[np.isfinite(depth) & (depth > 0)] if depth is not None else np.zeros(0)
    nearest = float(np.quantile(known, 0.02)) if len(known) else NEAREST_M
    if nearest < NEAREST_M:
        log.warning(
            "%s: depths from %.2f m on are nearer than depth cameras see: give the unit of its images, "
            "'?depth_scale=1000' for millimetres",
            source.name,
            nearest,
        )


def with_virtual_camera(rig: Rig) -> Rig:
    """The rig of a colour camera with depth: with a virtual right camera of the same lens."""
    if rig.depth and rig.stereo:
        return rig
    left_T_right = np.eye(4)
    left_T_right[0, 3] = VIRTUAL_BASELINE
    return replace(rig, right=rig.left, left_T_right=left_T_right, depth=True)


def _own_rig(folder: Path, label: str) -> Rig:
    for key, (fx, fy, cx, cy, *distortion) in INTRINSICS.items():
        if key in label:
            return Rig(RadTan(640, 480, fx, fy, cx, cy, tuple(distortion)), name=f"tum_rgbd {key}", readout_s=READOUT_S)
    raise StereoSfmError(
        f"{folder}: the folder's name does not contain the camera ({', '.join(INTRINSICS)}): give --rig FILE"
    )


def _read_listing(path: Path) -> list[tuple[int, Path]]:
    """(stamp_ns, file) of every line."""
    images: list[tuple[int, Path]] = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            images.append((stamp_from_seconds(fields[0]), path.parent / fields[1]))
        except (ValueError, IndexError):
            raise StereoSfmError(f"{path} line {number} is not 'seconds file'") from None
    return images
