"""Why tracking never began: the quick checks of `stereo_sfm.calib.start` on the first images of the run."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice

from stereo_sfm.calib.start import MAX_PAIRS, SPACING, why_no_start
from stereo_sfm.drivers.source import Source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.record import RunRecord


def why_not_started(opener: Callable[[], Source], record: RunRecord) -> str:
    """One line, "" if the run has a pose, no reason is found, or the images cannot be read again.

    Args:
        opener: gives the source that was run, not yet entered.
        record: of the run.
    """
    if not len(record.frames) or record.tracked().any():
        return ""
    try:
        with opener() as source:
            images = list(islice(source, 0, SPACING * (MAX_PAIRS - 1) + 1, SPACING))
            return why_no_start(source.rig, images)
    except StereoSfmError:
        return ""
