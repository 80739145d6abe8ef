"""A plant with its controller and effects, its equations over a period, and its simulation."""
