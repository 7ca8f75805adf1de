"""The masks of a recording's cameras: tracking gives the rotations for `calib.mask_search`."""

from __future__ import annotations

from stereo_sfm.calib.mask_search import FoundMask, MaskSearch
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import StereoImage, TrackState

TRACKED = (TrackState.OK, TrackState.RECOVERED)


class RecordedMasks:
    """Takes the images of a recording in order; images before and after a loss of tracking are not compared."""

    def __init__(self, rig: Rig) -> None:
        self._tracker, self._search, self._submap = make_tracker(Config(), rig), MaskSearch(), 0
        self._paired = rig.right is not None and not rig.depth

    def add(self, image: StereoImage) -> None:
        """Add one image or pair; a pair without its right image is left out."""
        if self._paired and image.right is None:
            return
        frame, keyframe = self._tracker.step(image)
        self._submap = self._submap if keyframe is None else keyframe.submap_id
        if frame.state in TRACKED:
            images = (image.left,) if image.right is None else (image.left, image.right)
            self._search.add(images, frame.odom_T_cam[:3, :3], self._submap)

    @property
    def turned(self) -> bool:
        """Whether the camera has turned enough for `find`."""
        return self._search.turned

    def find(self) -> list[FoundMask]:
        """The masks, one for each camera.

        Raises:
            StereoSfmError: the camera has not turned enough to distinguish the robot from distant scenery.
        """
        return self._search.find()
