"""The smallest light that does: ambient, spherical harmonics, and lights taken out of a map one by one."""
