"""The report of a calibration: one HTML file with embedded images."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.check import VERDICTS
from stereo_sfm.calib.coverage import Coverage
from stereo_sfm.calib.drawing import encode_jpeg, side_by_side
from stereo_sfm.calib.matches import Matches
from stereo_sfm.calib.quality import Quality
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.solve import Calibration
from stereo_sfm.types import F64, U8

_STYLE = """body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse}td,th{padding:.2em .8em;border-bottom:1px solid #ddd;text-align:left}
img{max-width:100%}.PASS{color:#187a2f}.WARN{color:#a06a00}.FAIL{color:#b3261e}"""


def write_report(
    path: Path,
    title: str,
    calibration: Calibration,
    quality: Quality,
    views: list[Coverage],
    pairs: list[tuple[U8, U8]],
) -> None:
    """Write the report.

    Args:
        path: of the HTML file. title: usually the source.
        views: coverage of each camera. pairs: some original images of both cameras, shown rectified.
    """
    verdict = VERDICTS[quality.level]
    rows = "".join(
        f'<tr><td class="{word}">{word}</td><td>{f.name}</td><td>{html.escape(f.text)}</td></tr>'
        for f in quality.findings
        for word in (VERDICTS[f.level],)
    )
    parts = [
        f"<h1>Calibration of {html.escape(title)}: <span class='{verdict}'>{verdict}</span></h1><table>{rows}</table>",
        _advice(views),
        "<h2>Parameters</h2>",
        _parameters(calibration),
        "<h2>Reprojection error</h2>",
        _image(_residuals(calibration)),
        "<h2>Coverage</h2><p>Views with corners in each region.</p>",
        _image(_regions([v.views.astype(float) for v in views], "{:.0f}", "viridis")),
    ]
    if calibration.rig.right is not None:
        parts += ["<h2>Epipolar error</h2>", _image(_epipolar(calibration, quality))]
        parts += [
            "<h2>Rectified pairs</h2><p>A point lies on the same row of both images.</p>",
            *_rectified(calibration, pairs),
        ]
    page = f"<!doctype html><meta charset='utf-8'><title>{html.escape(title)}</title><style>{_STYLE}</style>"
    path.write_text(page + "\n".join(parts) + "\n", encoding="utf-8")


def _advice(views: list[Coverage]) -> str:
    lines = [
        f"<li>{side} camera: {html.escape(a)}</li>"
        for side, v in zip(("left", "right"), views, strict=False)
        for a in v.advice
    ]
    return f"<h2>How to improve it</h2><ul>{''.join(lines)}</ul>" if lines else ""


def _parameters(calibration: Calibration) -> str:
    from stereo_sfm.geometry import se3
    from stereo_sfm.geometry.param_jacobian import parameter_vector

    rig = calibration.rig
    values: list[float] = []
    for camera in (rig.left, rig.right):
        if camera is not None:
            values += [float(v) for v in parameter_vector(camera)]
    if rig.right is not None:
        values += [*rig.left_T_right[:3, 3], *se3.so3_log(rig.left_T_right[:3, :3])]
    rows = "".join(
        f"<tr><td>{n}</td><td>{v:.6g}</td><td>&plusmn; {s:.2g}</td></tr>"
        for n, v, s in zip(calibration.names, values, calibration.sigma, strict=True)
    )
    used = f"{len(calibration.observed.view)} corners of {len(np.unique(calibration.observed.view))} views"
    removed = f"{calibration.removed_corners} corners and {calibration.removed_views} views removed as outliers"
    return f"<p>{used}; {removed}.</p><table>{rows}</table>"


def _figure(columns: int) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * columns, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def _image(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return f"<img src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"


def _residuals(calibration: Calibration) -> Any:
    observed, residual = calibration.observed, calibration.residual
    figure, axes = _figure(int(observed.side.max()) + 1)
    for side, axis in enumerate(axes):
        rows = observed.side == side
        uv, r = observed.uv[rows], residual[rows]
        size = np.linalg.norm(r, axis=1)
        scale = 0.03 * calibration.rig.left.width / max(float(np.quantile(size, 0.9)), 1e-6)
        arrows = axis.quiver(
            *uv.T, *(r.T * scale), size, angles="xy", scale_units="xy", scale=1, width=0.002, cmap="plasma"
        )
        figure.colorbar(arrows, ax=axis, label="px")
        axis.set(xlim=(0, calibration.rig.left.width), ylim=(calibration.rig.left.height, 0), aspect="equal")
        axis.set_title(f"{('left', 'right')[side]}: {np.sqrt((size**2).mean()):.3f} px rms")
    return figure


def _regions(grids: list[F64], form: str, colours: str) -> Any:
    figure, axes = _figure(len(grids))
    for name, axis, grid in zip(("left", "right"), axes, grids, strict=False):
        axis.imshow(grid, cmap=colours, vmin=0)
        for (r, c), value in np.ndenumerate(grid):
            axis.text(c, r, form.format(value), ha="center", va="center", color="white")
        axis.set(xticks=[], yticks=[], title=name)
    return figure


def _epipolar(calibration: Calibration, quality: Quality) -> Any:
    figure, axes = _figure(1)
    limit = max(float(np.quantile(np.abs(quality.epipolar_px), 0.95)), 0.1) if len(quality.epipolar_px) else 1.0
    dots = axes[0].scatter(*quality.epipolar_uv.T, c=quality.epipolar_px, s=9, cmap="coolwarm", vmin=-limit, vmax=limit)
    figure.colorbar(dots, ax=axes[0], label="row error, px")
    axes[0].set(xlim=(0, calibration.rig.left.width), ylim=(calibration.rig.left.height, 0), aspect="equal")
    return figure


def _rectified(calibration: Calibration, pairs: list[tuple[U8, U8]]) -> list[str]:
    projection = "epipolar" if calibration.rig.left.model == "kannala_brandt" else "pinhole"
    rectification = rectify(calibration.rig, projection)
    out: list[str] = []
    for left, right in pairs:
        image = side_by_side(*rectification.apply(left, right), Matches(np.zeros((0, 2)), np.zeros((0, 2))))
        out.append(f"<img src='data:image/jpeg;base64,{base64.b64encode(encode_jpeg(image)).decode()}'>")
    return out
