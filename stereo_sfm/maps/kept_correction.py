"""Self-calibration that goes on where the session before ended: a rig that was wrong yesterday is so today."""

from __future__ import annotations

import dataclasses

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calibration.rig_window import PRIOR
from stereo_sfm.calibration.self_calibration import Revision, SelfCalibration
from stereo_sfm.types import F64, Keyframe


class KeptCorrection(SelfCalibration):
    """The first revision is the correction of the session before; later ones are estimated from there on."""

    def __init__(self, rig: Rig, kept: F64, applies: bool) -> None:
        """`rig`: the calibrated rig. `kept`: (8,) terms of its correction. `applies`: as the self-calibration's."""
        super().__init__(with_terms(rig, kept), applies)
        self._kept, self._keyframes_so_far = kept, 0

    def add(self, keyframe: Keyframe) -> Revision | None:
        """As the self-calibration's; what was tracked with the rig before the correction tells nothing."""
        self._keyframes_so_far += 1
        if self._keyframes_so_far == 2:  # a map of one has no points that two keyframes see
            text = "as it ended in the session before of this camera"
            return Revision(self._kept.copy(), np.diag(PRIOR**2), 0, "kept", text)
        return self._in_all(super().add(keyframe)) if keyframe.rig_terms.any() else None

    def finish(self) -> Revision | None:
        """As the self-calibration's."""
        return self._in_all(super().finish())

    def _in_all(self, revision: Revision | None) -> Revision | None:
        """With the kept terms: small rotations add up."""
        if revision is None:
            return None
        on_the_way = tuple((kf_id, self._kept + terms) for kf_id, terms in revision.on_the_way)
        return dataclasses.replace(revision, terms=self._kept + revision.terms, on_the_way=on_the_way)
