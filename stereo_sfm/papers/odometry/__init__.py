"""One odometry estimator per file; `TABLE` names them."""
