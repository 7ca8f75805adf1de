"""OpenVINS's estimator_config.yaml, which names the files of its cameras and its IMU. Only read."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.calib.formats.common import read_yaml, reading
from stereo_sfm.calib.formats.kalibr import read_kalibr
from stereo_sfm.calib.rig import Rig


def read_openvins(path: Path | str, pair: tuple[int, int] = (0, 1), unit: float = 1.0) -> Rig:
    """The cameras and the IMU that the file names, read as Kalibr's; `pair` and `unit` as for `read_kalibr`."""
    path = Path(path)
    with reading(path, "OpenVINS"):
        data = read_yaml(path)
        chain, imu = (data.get(f"relative_config_{name}") for name in ("imucam", "imu"))
        if not chain:
            raise KeyError("relative_config_imucam")
        return read_kalibr(path.with_name(str(chain)), pair, path.with_name(str(imu)) if imu else None, unit)
