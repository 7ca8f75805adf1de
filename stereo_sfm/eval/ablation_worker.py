"""The worker processes of an ablation."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.eval.ablation import Cell, run_cell, save_result


def one_thread() -> None:
    """Limit libraries to one thread, since cells run in parallel."""
    import cv2
    import numba

    cv2.setNumThreads(1)
    numba.set_num_threads(1)


def compute(cell: Cell, path: Path) -> str:
    """Run a cell, write its file, and return a line that summarizes the result."""
    result = run_cell(cell)
    save_result(path, result)
    if result["status"] != "ok":
        return f"no result: {result['reason']}"
    return f"ATE {result['metrics']['ape_m']['rmse']:.4g} m, {result['track_ms'] or 0:.0f} ms per frame"
