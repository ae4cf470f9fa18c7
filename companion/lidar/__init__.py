"""Packets of a LiDAR to scans: decoding, the sensor clock, recorded packets, the socket."""
