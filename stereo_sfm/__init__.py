"""Visual structure-from-motion and SLAM for stereo cameras in retail stores."""

from __future__ import annotations

__version__ = "0.1.0"
