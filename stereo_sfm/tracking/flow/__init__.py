"""The default tracker: points followed by optical flow, matched in the second camera, solved for the pose."""
