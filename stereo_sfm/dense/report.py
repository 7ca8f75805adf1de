"""`report.md` of a reconstruction: what it is made of, figures, pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereo_sfm.dense.build import some_depths
from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.pictures import write_depth_picture
from stereo_sfm.errors import StereoSfmError

DEPTHS = 2  # depth images that are shown
PICTURES = (
    ("mesh_height.png", "The mesh, coloured by height (without what is above 1.9 m)"),
    ("mesh_grey.png", "The mesh with the images' grey levels"),
    ("height.png", "From above, coloured by height"),
    ("costmap.png", "Costmap: black occupied, white free, grey unknown"),
)


def write_report(folder: Path, source: str, voxel: float, numbers: dict[str, float]) -> Path:
    """Write report.md and its pictures of depth images; returns its path."""
    depths = some_depths(folder, DEPTHS)
    lines = [f"# Surfaces of {source}", "", "| | |", "|---|---|", f"| voxel | {100 * voxel:g} cm |"]
    lines += [f"| {name} | {value:,.0f} |" for name, value in numbers.items()]
    lines += [f"| depth images | {len(list((folder / 'depth').glob('*.npz')))} |", *_rows(depths)]
    for name, text in PICTURES:
        if (folder / name).is_file():
            lines += ["", f"{text}:", "", f"![{text}]({name})"]
    for number, depth in enumerate(depths, 1):
        name = f"depth_{number}.png"
        write_depth_picture(folder / name, depth)
        text = "A keyframe's image; its ranges, red near and blue far; their standard deviations, red 10 %"
        lines += ["", f"{text}:", "", f"![{text}]({name})"]
    path = folder / "report.md"
    try:
        path.write_text("\n".join([*lines, ""]), encoding="utf-8", errors="replace")
    except OSError as error:
        raise StereoSfmError(f"cannot write {path}: {error.strerror}") from None
    return path


def _rows(depths: list[DepthImage]) -> list[str]:
    """What the shown depth images are like."""
    if not depths:
        return []
    known = np.mean([np.isfinite(d.ranges).mean() for d in depths])
    relative = np.concatenate([(d.sigmas / d.ranges)[np.isfinite(d.ranges)] for d in depths])
    spread = f"{100 * np.median(relative):.1f} %" if len(relative) else "-"
    return [f"| pixels with depth | {100 * known:.0f} % |", f"| their standard deviation, median | {spread} |"]
