"""What can go wrong with a camera, one class per thing a person can do about it. Messages are one line."""

from __future__ import annotations

from stereo_sfm.errors import StereoSfmError


class DeviceError(StereoSfmError):
    """Any trouble with an attached camera."""


class NotFound(DeviceError):
    """No such camera is attached."""


class NoPermission(DeviceError):
    """The operating system does not let this user open the camera."""


class Busy(DeviceError):
    """Another program holds the camera."""


class TooSlowLink(DeviceError):
    """The camera hangs on a link that cannot carry its images."""


class FirmwareMissing(DeviceError):
    """The camera needs a firmware file that is not here or not the right one."""


class BootFailed(DeviceError):
    """The camera took its firmware but did not come back."""


class DeviceLost(DeviceError):
    """The camera is gone: unplugged, crashed, or silent."""


class DeviceFault(DeviceError):
    """The camera answers, but not what it should."""
