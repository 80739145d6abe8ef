"""Margins, lead compensators, and a controller redesigned on a model."""
