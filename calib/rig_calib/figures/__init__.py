"""Figures of the report: charts and plans as SVG, pictures as BGR images."""
