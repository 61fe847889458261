"""A calibrated rig in the file formats of other programs: one module a format, text in and text out."""
