"""PointMap -> surface -> VolumeReport."""

from companion.volume.estimate import estimate_volume
from companion.volume.paper import paper_volume

__all__ = ["estimate_volume", "paper_volume"]
