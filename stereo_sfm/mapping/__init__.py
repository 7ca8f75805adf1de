"""From keyframes to a map: association, bundle adjustment, culling."""
