"""The rig while driving: what keyframes show of cameras, IMU and wheels, and of what changed since calibration."""
