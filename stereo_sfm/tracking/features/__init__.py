"""The trackers of the papers: descriptors matched from frame to frame around a named motion estimator."""
