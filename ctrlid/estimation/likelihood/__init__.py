"""Physical parameters by maximum likelihood, with an extended Kalman filter."""
