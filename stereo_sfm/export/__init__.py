"""What leaves the project: trajectories, COLMAP, PLY, g2o, floor plans."""
