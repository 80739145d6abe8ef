"""Estimators of linear models: least squares, instruments, continuous time."""
