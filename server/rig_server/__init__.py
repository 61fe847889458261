"""The program on the PC: receive, decode and synchronise frames, then calibrate or fuse."""
