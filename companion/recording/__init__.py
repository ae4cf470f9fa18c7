"""Recordings: written in flight, read back, recovered, replayed."""
