"""Extrinsic calibration of a ring of RGB-D cameras, and fusion of what they see."""
