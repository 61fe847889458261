"""The program on each Raspberry Pi: grab RGB-D frames, encode them, send them over UDP."""
