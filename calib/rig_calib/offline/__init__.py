"""Work over a long take, panoramic frame by panoramic frame, on any number of processes."""
