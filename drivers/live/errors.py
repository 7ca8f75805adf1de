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


Meanings = tuple[tuple[str, type[DeviceError], str], ...]  # lower-case part of a message, error, its line


def translated(error: Exception, camera: str, meanings: Meanings) -> DeviceError:
    """An exception of a camera's library as one of ours, by the first meaning whose part its message has.

    Args:
        camera: its name, for messages without a meaning.
    """
    if isinstance(error, DeviceError):
        return error
    text = str(error).lower()
    for piece, kind, line in meanings:
        if piece in text:
            return kind(line)
    return DeviceFault(f"{camera}: {str(error).splitlines()[0] if str(error) else type(error).__name__}")
