"""The ablation as tables, plots and checked claims: the retail paper's Table II and Figure 5 for each sequence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.eval.plots import plot_trajectory
from stereo_sfm.eval.tables import write_table
from stereo_sfm.types import F64, Trajectory

CellResult = dict[str, Any]

# Published numbers on the same data: (part of the source's name, system, what, value).
PUBLISHED: tuple[tuple[str, str, str, str], ...] = (
    ("freiburg1_xyz", "Sparse Visual Localization, table I (whole sequence)", "ATE (equation 44)", "0.167 m"),
    ("kitti:07", "Retail thesis, table II, tracking", "relative 0.012 rad, 0.17 m; absolute", "0.27 rad, 33.95 m"),
    ("kitti:07", "Retail thesis, local mapping", "relative 0.0022 rad, 0.067 m; absolute", "0.21 rad, 18.23 m"),
    ("kitti:07", "Retail thesis, averaging", "relative 0.0031 rad, 0.081 m; absolute", "0.19 rad, 23.76 m"),
    ("kitti:07", "Retail thesis, pose graph", "relative 0.0027 rad, 0.075 m; absolute", "0.069 rad, 21.07 m"),
)
COLUMNS = (
    "system", "features", "odometry", "stage", "rel rot mean [rad]", "rel rot std [rad]", "rel trans mean [m]",
    "rel trans std [m]", "abs rot [rad]", "abs trans [m]", "ATE [m]", "ATE Sim(3) [m]", "mean error [m]", "drift [%]",
    "track [ms]", "frame [ms]", "lost", "keyframes", "loops", "no result because",
)  # fmt: skip


def row_of(result: CellResult) -> dict[str, Any]:
    """One line of the table. Translations are metres (Table II's unit), not equation 24's squares."""
    cell = result["cell"]
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "")
    row |= {"system": cell["system"], "features": cell["features"], "odometry": cell["method"], "stage": cell["stage"]}
    lost = result.get("frames", 0) - result.get("tracked", 0)
    row |= {
        "track [ms]": result.get("track_ms"),
        "frame [ms]": result.get("frame_ms"),
        "lost": lost if "frames" in result else "",
        "keyframes": result.get("keyframes", ""),
        "loops": result.get("loops", ""),
        "no result because": result["reason"],
    }
    if result["status"] != "ok":
        return row
    metrics = result["metrics"]
    retail, rpe, drift = metrics["retail"], metrics["rpe_m"], metrics["drift"]
    monocular = result["monocular"]
    row |= {
        "rel rot mean [rad]": retail["relative_rotation_rad_mean"],
        "rel rot std [rad]": retail["relative_rotation_rad_std"],
        "abs rot [rad]": retail["absolute_rotation_rad"],
        "ATE Sim(3) [m]": metrics["ate_sim3_m"],
    }
    if not monocular:  # a monocular run has no metric scale before Sim(3)
        row |= {
            "rel trans mean [m]": rpe["mean"],
            "rel trans std [m]": rpe["std"],
            "abs trans [m]": math.sqrt(retail["absolute_translation_m2"]),
            "ATE [m]": metrics["ape_m"]["rmse"],
            "mean error [m]": result["mean_error_m"],
            "drift [%]": drift["translation_percent"] if drift else None,
        }
    return row


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)


def markdown_table(results: Sequence[CellResult]) -> str:
    """All columns, one line per cell."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(_text(row[c]) for c in COLUMNS) + " |" for row in map(row_of, results)]
    return "\n".join(lines)


def overview(results: Sequence[CellResult]) -> str:
    """The errors of one source at a glance: ATE in metres and the tracker's milliseconds, a column for each feature."""
    grid = {_place(a): a for a in results if a["cell"]["system"] == "grid"}
    kinds = list(dict.fromkeys(kind for _, _, kind in grid))
    rows = list(dict.fromkeys((method, stage) for method, stage, _ in grid))
    lines = [
        "| odometry | stage | " + " | ".join(kinds or ["result"]) + " |",
        "|---|---|" + "---|" * max(len(kinds), 1),
    ]
    for method, stage in rows:
        cells = [_brief(grid.get((method, stage, kind))) for kind in kinds]
        lines.append(f"| {method} | {stage} | " + " | ".join(cells) + " |")
    for result in results:
        if result["cell"]["system"] != "grid":
            system, stage = result["cell"]["system"], result["cell"]["stage"]
            lines.append(f"| **{system}** | {stage} | {_brief(result)} |" + " |" * (len(kinds) - 1))
    return "\n".join(lines)


def _place(result: CellResult) -> tuple[str, str, str]:
    cell = result["cell"]
    return cell["method"], cell["stage"], cell["features"]


def _brief(result: CellResult | None) -> str:
    if result is None:
        return "-"
    if result["status"] != "ok":
        return result["reason"]
    metrics, ms = result["metrics"], result["track_ms"] or 0.0
    sim3 = f"{metrics['ate_sim3_m']:.3g} m"
    error = f"({sim3})" if result["monocular"] else f"{metrics['ape_m']['rmse']:.3g} m ({sim3})"
    return f"{error}, {ms:.0f} ms"


def write_tables(path: Path, results: Sequence[CellResult]) -> None:
    """Every cell of every source, as CSV and Parquet; `path` has no suffix."""
    rows: list[list[Any]] = []
    for result in results:
        row = row_of(result)
        values = [row[name] for name in COLUMNS]
        rows.append([result["cell"]["source"], *values, " ".join(_settings(result))])
    write_table(path, ("source", *COLUMNS, "set"), rows)


def _settings(result: CellResult) -> tuple[str, ...]:
    """The values given by `--set` in a cell."""
    return tuple(result["cell"].get("settings", ()))


def _ate(result: CellResult | None) -> float:
    """Metres; infinite where there is no result, so that a failure never wins."""
    return float(result["metrics"]["ape_m"]["rmse"]) if result is not None and result["status"] == "ok" else math.inf


def _metres(error: float) -> str:
    return f"{error:.3g} m" if math.isfinite(error) else "no result"


def _ate_sim3(result: CellResult) -> float:
    """Metres, of a cell with a result: the error of the path apart from its scale."""
    return float(result["metrics"]["ate_sim3_m"])


def _step(result: CellResult) -> float:
    """Metres, of a cell that has a result: mean error of the translation between frames."""
    return float(result["metrics"]["rpe_m"]["mean"])


def _turn(result: CellResult | None) -> float:
    """Mean relative rotation error in radians, infinite where there is no result."""
    if result is None or result["status"] != "ok":
        return math.inf
    return float(result["metrics"]["retail"]["relative_rotation_rad_mean"])


def findings(results: Sequence[CellResult]) -> list[str]:
    """The papers' claims, checked on one source; each line gives the numbers that decide it."""
    cells = {
        (a["cell"]["features"], a["cell"]["method"]): a
        for a in results
        if a["cell"]["system"] == "grid" and a["cell"]["stage"] == "tracking"
    }
    kinds = sorted({k for k, _ in cells})
    methods = sorted({m for _, m in cells})
    lines: list[str] = []
    for method in methods:
        scores = {kind: _ate(cells.get((kind, method))) for kind in kinds}
        if len(scores) > 1 and min(scores.values()) < math.inf:
            order = sorted(scores, key=lambda kind: scores[kind])
            agreed = order[0] == "sift" and order[-1] == "orb"
            text = ", ".join(f"{kind} {_metres(scores[kind])}" for kind in order)
            lines.append(f"SIFT best and ORB worst with {method}: {'yes' if agreed else 'no'} ({text})")
    for kind in kinds:
        scores = {method: _ate(cells.get((kind, method))) for method in methods}
        if len(scores) > 1 and min(scores.values()) < math.inf:
            order = sorted(scores, key=lambda method: scores[method])
            text = ", ".join(f"{method} {_metres(scores[method])}" for method in order)
            lines.append(f"EM-R best with {kind}: {'yes' if order[0] == 'em-r' else 'no'} ({text})")
        robust, plain = cells.get((kind, "r-um")), cells.get((kind, "um"))
        if robust is not None and plain is not None:
            agreed = _ate(robust) < _ate(plain)
            lines.append(
                f"RANSAC needed with {kind}: {'yes' if agreed else 'no'} "
                f"(R-Um {_metres(_ate(robust))}, Um {_metres(_ate(plain))}; "
                f"rotation {_turn(robust):.2g} and {_turn(plain):.2g} rad per frame)"
            )
    return lines + _against_default(results)


def _against_default(results: Sequence[CellResult]) -> list[str]:
    """Whether the default system beats every other cell in accuracy and in time."""
    ours = [a for a in results if a["cell"]["system"] == "default" and a["status"] == "ok"]
    others = [a for a in results if a["cell"]["system"] != "default" and a["status"] == "ok" and not a["monocular"]]
    if not ours or not others:
        return []
    lines: list[str] = []
    for error, name in ((_ate, "ATE"), (_ate_sim3, "Sim(3) ATE"), (_step, "translation from frame to frame")):
        best, closest = min(ours, key=error), min(others, key=error)
        lines.append(
            f"the default is more accurate than every cell, {name}: {'yes' if error(best) < error(closest) else 'no'} "
            f"({_cell_name(best)} {error(best):.3g} m, next {_cell_name(closest)} {error(closest):.3g} m)"
        )
    fastest = min(others, key=lambda a: a["track_ms"])
    slowest = max(ours, key=lambda a: a["track_ms"])
    lines.append(
        f"the default is faster than every cell: {'yes' if slowest['track_ms'] < fastest['track_ms'] else 'no'} "
        f"({_cell_name(slowest)} {slowest['track_ms']:.0f} ms per frame, "
        f"next {_cell_name(fastest)} {fastest['track_ms']:.0f} ms)"
    )
    return lines


def _cell_name(result: CellResult) -> str:
    cell = result["cell"]
    parts = [cell["features"], cell["method"]] if cell["system"] == "grid" else [cell["system"]]
    return " ".join(p for p in [*parts, cell["stage"]] if p)


def _path(points: Any) -> Trajectory:
    xyz: F64 = np.asarray(points, float)
    poses = np.tile(np.eye(4), (len(xyz), 1, 1))
    poses[:, :3, 3] = xyz
    return Trajectory(np.arange(len(xyz), dtype=np.int64), poses)


def write_plots(folder: Path, slug: str, results: Sequence[CellResult]) -> list[str]:
    """Figure 5 of the retail paper: estimators by features, then the modules in order. Returns the file names."""
    good = [a for a in results if a["status"] == "ok"]
    groups: dict[str, list[CellResult]] = {}
    for result in good:
        cell = result["cell"]
        if cell["system"] != "grid":
            groups.setdefault("systems", []).append(result)
            continue
        if cell["stage"] == "tracking":
            groups.setdefault(f"tracking-{cell['features']}", []).append(result)
        groups.setdefault(f"stages-{cell['features']}-{cell['method']}", []).append(result)
    written: list[str] = []
    for name, members in sorted(groups.items()):
        if name.startswith("stages") and len(members) < 2:
            continue
        path = folder / f"{slug}-{name}.png"
        longest = max(members, key=lambda a: len(a["true_path"]))
        plot_trajectory(path, {_cell_name(a): _path(a["path"]) for a in members}, _path(longest["true_path"]))
        path.with_suffix(".svg").unlink()  # the report is Markdown
        written.append(path.name)
    return written


def write_report(folder: Path, results: Sequence[CellResult]) -> Path:
    """ablation.md, ablation.csv, ablation.parquet and the plots. Returns the path of the first."""
    write_tables(folder / "ablation", results)
    lines = ["# Ablation", ""]
    lines += [
        "Relative errors are between consecutive frames, absolute ones of the last pose with the first poses aligned "
        "(retail paper, equations 23 and 24; translations as metres, not squared). ATE is the RMSE after SE(3) "
        "alignment, `mean error` the mean distance of the same poses (the sparse localization paper's equation 44, "
        "read as the mean over the frames of the distance under its root). "
        "Drift as KITTI's, over segments that fit the path. `track` is the tracker's median; `frame` the whole run, "
        "with reading, compiling and mapping, per frame. The first table of a source gives the ATE, after Sim(3) in "
        "brackets, and the tracker's median.",
        "",
    ]
    for settings in dict.fromkeys(map(_settings, results)):
        if settings:
            lines += ["Set in every cell: " + ", ".join(f"`{setting}`" for setting in settings) + ".", ""]
    for number, source in enumerate(dict.fromkeys(a["cell"]["source"] for a in results)):
        own = [a for a in results if a["cell"]["source"] == source]
        name = next((a["source_name"] for a in own if "source_name" in a), source)
        length = next((a["metrics"]["length_m"] for a in own if a["status"] == "ok"), None)
        frames = max((a.get("frames", 0) for a in own), default=0)
        lines += [f"## {name}", "", f"{frames} frames" + (f", {length:.2f} m" if length else ""), ""]
        lines += [overview(own), ""]
        checked = findings(own)
        if checked:
            lines += ["Claims of the papers, checked:", "", *[f"- {line}" for line in checked], ""]
        lines += [markdown_table(own), ""]
        published = [row for row in PUBLISHED if row[0] in name or row[0] in source]
        lines += [f"- published: {system}: {what} {value}" for _, system, what, value in published]
        slug = f"{number + 1:02d}"
        lines += ["", *[f"![{plot}]({plot})" for plot in write_plots(folder, slug, own)], ""]
    path = folder / "ablation.md"
    path.write_text("\n".join(lines), encoding="utf-8", errors="replace")
    return path
