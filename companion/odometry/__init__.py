"""Odometry: scans, attitude and rangefinder in, the pose of the body in `map` with its quality out."""

from companion.odometry.odometry import Odometry, ScanResult

__all__ = ["Odometry", "ScanResult"]
