"""Use the same machine code on every x86-64 processor with AVX2, whatever other features it has.

numpy, OpenCV and OpenBLAS choose code by the processor's features, and code for AVX-512 sums in another order than code
for AVX2: keyframes' descriptors and whole paths then differ in their last bits, and after a few decisions in
millimetres. AVX-512 is therefore disabled in this process and those that it starts. The variables are those that each
library documents; one that is set already is left as it is, and so is everything once a library is loaded.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

LIBRARIES = ("numpy", "cv2", "scipy")
NUMPY = "X86_V4 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
CHOICE = "STEREO_SFM_CODE"  # what was chosen, for processes that are started later
CPU_INFO = Path("/proc/cpuinfo")


def choose() -> None:
    """Set the variables if no library has read them yet; child processes inherit them."""
    if CHOICE in os.environ:
        return
    free = not any(name in sys.modules for name in LIBRARIES)
    os.environ[CHOICE] = "avx2" if free else "as it was"
    for name, value in variables(_features()).items() if free else ():
        os.environ.setdefault(name, value)


def variables(features: frozenset[str]) -> dict[str, str]:
    """Environment variables that restrict a processor with these features (Linux names) to AVX2."""
    if not {"avx2", "fma"} <= features:
        return {}
    chosen = {"OPENBLAS_CORETYPE": "Haswell"}
    if "avx512f" in features:
        chosen |= {"NPY_DISABLE_CPU_FEATURES": NUMPY, "OPENCV_CPU_DISABLE": "AVX512-SKX"}
    return chosen


def _features() -> frozenset[str]:
    try:
        with CPU_INFO.open() as file:
            first = file.read(8192)  # of the first core
    except OSError:
        return frozenset()
    flags = next((line for line in first.splitlines() if line.startswith("flags")), "")
    return frozenset(flags.split())
