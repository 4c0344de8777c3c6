"""The poses of two LiDARs or more from all that was recorded, with their covariance and the tests
of what does not fit."""
