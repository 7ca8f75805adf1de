"""The calibration type, its file formats, and the calibration of cameras."""
