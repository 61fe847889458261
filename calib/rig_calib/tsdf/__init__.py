"""Truncated signed distances of what a rig measured, weighted by its noise, and the mesh at their zero."""
