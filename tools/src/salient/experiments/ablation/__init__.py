"""What each estimator and correction of the controller `salient` contributes: runs without it."""
