"""Depth images, volumes and meshes from a run's keyframes and the poses of its map."""
