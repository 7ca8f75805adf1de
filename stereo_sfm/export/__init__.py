"""Exporters: trajectories, COLMAP, PLY, g2o, floor plans."""
