"""What runs in the processes of an ablation."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.eval.ablation import Cell, run_cell, save_answer


def one_thread() -> None:
    """Cells run side by side: inside one, libraries compute in one thread."""
    import cv2
    import numba

    cv2.setNumThreads(1)
    numba.set_num_threads(1)


def compute(cell: Cell, path: Path) -> str:
    """Run a cell, write its file, and say in a line what came out."""
    answer = run_cell(cell)
    save_answer(path, answer)
    if answer["status"] != "ok":
        return f"no result: {answer['reason']}"
    return f"ATE {answer['metrics']['ape_m']['rmse']:.4g} m, {answer['track_ms'] or 0:.0f} ms a frame"
