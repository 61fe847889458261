"""Panoramic frames of a capture in the file formats of other programs: one module a format."""
