"""diagnose(): where simulation and data disagree, which effect is missing, and what it closes."""
