"""Exact equations of any python-control system, its operating point and linear model."""
