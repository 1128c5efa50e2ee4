"""The Kalman filter of the estimator in the loop."""
