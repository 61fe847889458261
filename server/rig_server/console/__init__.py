"""The console: the rig in a web browser."""
