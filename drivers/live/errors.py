"""Errors of cameras, one class per remedy. Messages are one line."""

from __future__ import annotations

from stereo_sfm.errors import StereoSfmError


class DeviceError(StereoSfmError):
    """Any error of a camera."""


class NotFound(DeviceError):
    """No such camera is attached."""


class NoPermission(DeviceError):
    """The user has no permission to open the camera."""


class Busy(DeviceError):
    """Another program uses the camera."""


class TooSlowLink(DeviceError):
    """The USB link is too slow for the images."""


class FirmwareMissing(DeviceError):
    """The camera needs a firmware file that is missing or wrong."""


class BootFailed(DeviceError):
    """The camera did not come back after loading its firmware."""


class DeviceLost(DeviceError):
    """The camera is unplugged, crashed, or does not respond."""


class DeviceFault(DeviceError):
    """The camera gives an unexpected answer."""
