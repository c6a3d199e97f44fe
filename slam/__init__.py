"""Touch to map: tactile images, RatSLAM, odometry, metrics. Pure."""
