"""One odometry estimator per file."""
