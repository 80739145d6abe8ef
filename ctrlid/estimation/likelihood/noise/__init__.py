"""The most likely noise of force and sensor, for parameters as they are."""
