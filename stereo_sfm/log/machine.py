"""Properties of the processor that affect the last bits: OpenCV, BLAS and the kernels choose code by its features."""

from __future__ import annotations

import importlib
import platform
from pathlib import Path

FEATURES = 512  # OpenCV numbers the features of all processors below


def arithmetic() -> dict[str, str]:
    """Properties by name, as kept in a log: machines with equal properties give the same bits."""
    return {
        "processor": _processor(),
        "opencv_dispatch": _opencv_dispatch(),
        "blas": _blas(),
        "kernels": _kernels(),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    return f"{platform.machine()} {model or platform.processor()}".strip()


def _opencv_dispatch() -> str:
    """The instruction sets used by OpenCV here, without those disabled by OPENCV_CPU_DISABLE."""
    import cv2

    built: list[str] = []
    for line in cv2.getBuildInformation().splitlines():
        name, _, words = line.partition(":")
        if name.strip() in ("Baseline", "Dispatched code generation"):
            built += words.split()
    names = {cv2.getHardwareFeatureName(i).replace("-", "_").replace(".", "_"): i for i in range(FEATURES)}
    return " ".join(word for word in built if word in names and cv2.checkHardwareSupport(names[word]))


def _blas() -> str:
    """Library, version and kernel of numpy's and scipy's BLAS."""
    import threadpoolctl

    importlib.import_module("scipy.linalg")  # loads its library
    found = [m for m in threadpoolctl.threadpool_info() if m["user_api"] == "blas" and "opencv" not in m["filepath"]]
    return ", ".join(sorted({f"{m['internal_api']} {m['version']} {m.get('architecture', '')}".strip() for m in found}))


def _kernels() -> str:
    """The processor that numba compiles for."""
    import llvmlite.binding as llvm
    from numba import config

    chosen: str | None = getattr(config, "CPU_NAME", None)
    return chosen or str(llvm.get_host_cpu_name())
