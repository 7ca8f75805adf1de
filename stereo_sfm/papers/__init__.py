"""The trackers of the papers, a plug-in of `tracking`: descriptors matched from frame to frame around an estimator."""
