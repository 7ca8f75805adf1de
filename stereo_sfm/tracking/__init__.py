"""From images to frames: features, flow, matching, pose, keyframes."""
