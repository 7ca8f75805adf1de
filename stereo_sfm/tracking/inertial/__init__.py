"""Inertial motion: prediction, and the motion itself when images fail."""
